"""What the data doctor finds in the logs of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from residnet.core.log import Log
from residnet.core.progress import say
from residnet.data.doctor import inspect, inspect_together, inspection, summary
from residnet.data.masks import Spike
from residnet.runs.folder import RunFolder
from residnet.tasks.fit.config import FitTaskSettings


def write_inspection(
    folder: RunFolder, splits: Mapping[str, Sequence[Log]], config: FitTaskSettings
) -> None:
    """Write doctor.json: what the doctor finds in all logs as the run's masks leave them."""
    logs = [log for members in splits.values() for log in members]
    reports = [
        inspect(log, config.signals.columns, (*config.prepare.masks, Spike())) for log in logs
    ]
    split_of = {log.name: split for split, members in splits.items() for log in members}
    together = inspect_together(logs, config.signals.columns, split_of)
    for report in reports:
        for finding in report.find("fill_values"):
            say(f"  {report.name}: {finding.text}")
    content = inspection(reports, together)
    folder.write_json(folder.path / "doctor.json", content)
    # the tally stands in the verdict; what may be corrected is told before the fit takes its time
    if first := summary(content).first:
        say(f"  {first}")
