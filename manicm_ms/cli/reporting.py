"""`manicm-ms report`: a training on one page."""

from __future__ import annotations

from pathlib import Path

import tyro


def report_command(
    checkpoint: tyro.conf.Positional[Path], evaluations: tuple[Path, ...] = (), out: Path | None = None
) -> None:
    """Write a page on a training: curves, configuration, data, evaluations, and how to make it again.

    A training that is still under way, or was stopped, is shown as far as it is; it is not disturbed.

    Args:
        checkpoint: checkpoint folder of 'train' or 'distill'.
        evaluations: folders of finished evaluations of it, as 'evaluate' writes them.
        out: folder of report.html and report.md; by default CHECKPOINT.report.
    """
    from manicm_ms.reports.training_report import report_training

    print(report_training(checkpoint, evaluations, out))
