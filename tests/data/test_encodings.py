"""Text logs in the encodings that recorders, shells and Excel write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drafted_logs import drafted

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.readers.detect import AutoConfig, format_of
from residnet.data.readers.formats.topic_folder import TopicFolderConfig
from residnet.data.readers.recording import EVERYTHING
from residnet.data.readers.texts import encoding_of

T = np.arange(0.0, 30.0, 0.1)
NORTH = 2.0 * T
HEADER = "Zeit [s];Nord [m];Ost [m];Kurs [°];Ruder [°];Länge über alles [m]"
GERMAN = "\r\n".join(
    [HEADER, *(f"{t:.1f};{2 * t:.2f};0,0;0,5;{5 * np.sin(t):.3f};12".replace(".", ",") for t in T)]
)
JAPANESE = "\n".join(
    ["時間 [s],北 [m],東 [m],方位 [deg]", *(f"{t:.1f},{2 * t:.2f},0,0" for t in T)]
)


def read(path: Path, **settings: object) -> Log:
    """Return the log in a table by the map that residnet drafts."""
    return drafted(path, **settings)[0]


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        *((GERMAN, name) for name in ("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32")),
        *((GERMAN, name) for name in ("cp1252", "cp850", "mac_roman")),
        *((JAPANESE, name) for name in ("utf-8", "utf-16", "cp932")),
    ],
)
def test_a_table_in_an_encoding(text: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes((text + "\r\n").encode(encoding))
    log = read(path)
    np.testing.assert_allclose(log["x"], NORTH, atol=1e-9)
    np.testing.assert_allclose(np.degrees(log["psi"]), 0.5 if text is GERMAN else 0.0)


def test_the_encoding_may_be_told_and_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes((GERMAN + "\r\n").encode("utf-16"))
    assert len(read(path, encoding="utf-16")) == T.size
    with pytest.raises(DataError, match="not UTF-8 text"):
        read(path, encoding="utf-8")


def test_a_letter_far_down_tells_the_encoding(tmp_path: Path) -> None:
    """The first megabyte may be plain ASCII."""
    path = tmp_path / "log.csv"
    path.write_bytes(b"t,note\n" + b"1.0,calm\n" * 130_000 + "2.0,Böe\n".encode("cp1252"))
    assert encoding_of(path) == "cp1252"


@pytest.mark.parametrize("lost", [1, 2, 7])
def test_a_file_that_was_cut_within_a_sign(lost: int, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(GERMAN.encode("utf-16")[:-lost])
    assert len(read(path)) >= T.size - 1


def test_numbers_among_zero_bytes_are_no_utf_16(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(GERMAN.encode("utf-8").replace(b"0,5", b"\x00\x00\x00"))
    with pytest.raises(DataError, match=r"zero byte|no text"):
        read(path)


@pytest.mark.parametrize("filled", [1, 200_000])
def test_a_file_that_its_recorder_filled_with_zeros(filled: int, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(GERMAN.encode("utf-8") + b"\x00" * filled)
    assert len(read(path)) == T.size


def test_sentences_that_a_shell_of_windows_wrote(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_bytes(_with_checksums().encode("utf-16"))
    found = format_of(path)
    assert found is not None
    assert found.name == "NMEA 0183"
    latitude = AutoConfig().load(path, EVERYTHING).series["RMC"].fields["latitude"]
    np.testing.assert_allclose(latitude, [59 + (54.320 + 0.001 * i) / 60 for i in range(5)])


def test_topics_in_utf_16(tmp_path: Path) -> None:
    for name in ("pose", "speed"):
        rows = "".join(f"{t:.1f},{2 * t:.2f}\n" for t in T)
        (tmp_path / f"{name}.csv").write_bytes(f"time,{name}_x\n{rows}".encode("utf-16"))
    series = TopicFolderConfig().load(tmp_path).series
    np.testing.assert_allclose(series["pose"].fields["pose_x"], NORTH, atol=1e-9)


def _with_checksums() -> str:
    lines = []
    for i in range(5):
        body = f"GPRMC,12000{i}.00,A,5954.32{i},N,01030.5,E,4.0,90.0,010124,,,A"
        checksum = 0
        for letter in body:
            checksum ^= ord(letter)
        lines.append(f"${body}*{checksum:02X}\r\n")
    return "".join(lines)
