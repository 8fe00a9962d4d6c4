"""The command line: `manicm-ms COMMAND`; each command imports only what it needs.

This file assembles the commands, which lie in files of their own. What a user can cause ends in one line on standard
error and exit status 2. Commands that do long work go on where they were stopped when the same command is given again.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Sequence

import tyro

from manicm_ms import signals
from manicm_ms.cli import benchmarking, cameras, checking, comparing, demonstrations, evaluating, reporting
from manicm_ms.cli.counts import checked
from manicm_ms.cli.messages import PROGRAM, explain, report_error, warnings_in_one_line
from manicm_ms.errors import ManicmError, UnknownNameError

Command = Callable[..., int | None]
USER_ERROR, INTERRUPTED = 2, 130
_RESUMABLE = ("collect", "train", "distill", "evaluate", "compare", "benchmark")

PLAIN: dict[str, Command] = {
    "list": checking.list_command,
    "check": checking.check_command,
    "collect": demonstrations.collect_command,
    "experts": demonstrations.experts_command,
    "inspect": demonstrations.inspect_command,
    "convert": demonstrations.convert_command,
    "evaluate": evaluating.evaluate_command,
    "compare": comparing.compare_command,
    "report": reporting.report_command,
    "benchmark": benchmarking.benchmark_command,
    "calibrate": cameras.calibrate_command,
    "board": cameras.board_command,
    "cloud": cameras.cloud_command,
    "doctor": checking.doctor_command,
}
# These depend on the preset that the command line names: its fields become options with its values as defaults.
WITH_PRESET = {
    "train": "Train a policy on demonstrations; the same command goes on after Ctrl-C or a kill.",
    "distill": "Distil a teacher into a one-step ManiCM student; the same command goes on after Ctrl-C or a kill.",
}
# Commands with commands of their own.
GROUPS = {"bench": "Time environments, decisions, experts and sensors; 'manicm-ms bench --help' lists what."}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its status.

    It is 0 good, 1 a check failed, 2 a user error, 130 stopped by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with signals.stoppable():
            code = _run(arguments)
    except ManicmError as error:
        report_error(str(error))
        code = USER_ERROR
    except OSError as error:
        report_error(explain(error))
        code = USER_ERROR
    except KeyboardInterrupt as stop:
        goes_on = arguments[0] in _RESUMABLE if arguments else False
        print("stopped; the same command goes on from here" if goes_on else "stopped", file=sys.stderr)
        code = getattr(stop, "status", INTERRUPTED)
        signals.end_stopped(code)
    sys.exit(code or 0)


def _run(arguments: list[str]) -> int | None:
    if not arguments or arguments[0] in ("-h", "--help"):
        _overview()
        return 0 if arguments else USER_ERROR
    if arguments[0] == "--version":
        from manicm_ms import __version__

        print(__version__)
        return 0
    name, rest = arguments[0], arguments[1:]
    if name not in (*PLAIN, *WITH_PRESET, *GROUPS):
        raise UnknownNameError("command", name, (*PLAIN, *WITH_PRESET, *GROUPS))
    with warnings_in_one_line():
        if name in GROUPS:
            from manicm_ms.cli import bench

            return bench.run(rest)
        if name == "distill":
            from manicm_ms.cli.training import present_flags

            rest = present_flags(rest)
        return tyro.cli(
            checked(command_of(name, rest)), prog=f"{PROGRAM} {name}", args=rest, config=(tyro.conf.OmitArgPrefixes,)
        )


def command_of(name: str, arguments: Sequence[str]) -> Command:
    """Return what runs the command `name`: its signature gives the options; `arguments` name their preset."""
    if name in PLAIN:
        return PLAIN[name]
    from manicm_ms.cli import training  # torch and the presets: a second that the other commands need not wait

    return {"train": training.train_command, "distill": training.distill_command}[name](arguments)


def _overview() -> None:
    from manicm_ms.cli.listing import console

    print(f"usage: {PROGRAM} COMMAND ...   ('{PROGRAM} COMMAND --help' tells more)\n")
    plain = {name: (command.__doc__ or "").splitlines()[0] for name, command in PLAIN.items()}
    width = console().width
    for name, summary in {**plain, **WITH_PRESET, **GROUPS}.items():
        print(textwrap.fill(f"  {name:<9} {summary}", width, subsequent_indent=" " * 12, break_on_hyphens=False))
