"""Run folders as an attacker edits them: every sum is corrected afterwards."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from residnet.core.ownership import SCHEMA


def _is_regular(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def forge_sums(run: Path) -> None:
    """Correct the sums of a run folder and of its models after files in it were edited."""
    for card in run.glob("models/*/model.json"):
        if not (_is_regular(card) and _is_regular(card.parent / "model.safetensors")):
            # a FIFO would be waited for, and a link to a device never ends
            continue
        try:
            content = json.loads(card.read_text())
            weights = (card.parent / "model.safetensors").read_bytes()
            content["sha256"] = hashlib.sha256(weights).hexdigest()
            content.pop("description_sha256", None)
            text = json.dumps(content, sort_keys=True).encode()
            content["description_sha256"] = hashlib.sha256(text).hexdigest()
        except (OSError, ValueError, AttributeError, TypeError):
            # edited beyond recognition
            continue
        card.write_text(json.dumps(content, indent=1) + "\n")
    manifests = sorted(run.rglob("checksums.json"), key=lambda path: -len(path.parts))
    for manifest in filter(_is_regular, manifests):
        folder = manifest.parent
        names = (path for path in sorted(folder.rglob("*")) if path != manifest)
        files = {
            path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in names
            if _is_regular(path)
        }
        manifest.write_text(json.dumps({"schema": SCHEMA, "files": files}))
