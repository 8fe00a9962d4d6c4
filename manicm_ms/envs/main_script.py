"""Whether worker processes can import the script that starts them: Python imports it in each of them."""

from __future__ import annotations

import ast
import multiprocessing
import os
import sys
from pathlib import Path

from manicm_ms.errors import ConfigError

NO_GUARD_STATUS = 83
"""Exit status of a worker that, importing the script, was asked to make an environment."""


def no_guard(path: str) -> ConfigError:
    """Return the error that says what is missing."""
    return ConfigError(
        f"{path} has no main guard, and every worker process imports it: put what it does under "
        'if __name__ == "__main__":'
    )


def require_importable_main() -> None:
    """Raise ConfigError where the script that runs is read from standard input, or starts workers without a main guard.

    A worker process that imports such a script ends here, with `NO_GUARD_STATUS`: its parent tells.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        os._exit(NO_GUARD_STATUS)
    main = sys.modules["__main__"]
    spec_name = getattr(getattr(main, "__spec__", None), "name", None)
    path = getattr(main, "__file__", None)
    if path is None or (spec_name or "").rpartition(".")[2] == "__main__":
        return  # a notebook, an interactive session, python -c, or a package's own __main__: never imported
    if not Path(path).is_file():
        raise ConfigError(
            f"this script is read from standard input ({path}), where worker processes cannot import it: save it to a "
            'file, put what it does under if __name__ == "__main__":, and run that'
        )
    line = _running_line(main.__dict__)
    if line is not None and not _is_guarded(Path(path), line):
        raise no_guard(path)


def main_script() -> str:
    """Return the path of the script that runs, for messages."""
    return str(getattr(sys.modules["__main__"], "__file__", "the script"))


def _running_line(names: dict[str, object]) -> int | None:
    """Return the line of the script's top level that led here, or None where it did not."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_globals is names and frame.f_code.co_name == "<module>":
            return frame.f_lineno
        frame = frame.f_back  # type: ignore[assignment]
    return None


def _is_guarded(path: Path, line: int) -> bool:
    """Return whether the top-level statement at `line`, or one before it, looks at `__name__`. In doubt it does."""
    try:
        statements = ast.parse(path.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return True
    before = [statement for statement in statements if statement.lineno <= line]
    return any(_looks_at_name(statement) for statement in before)


def _looks_at_name(statement: ast.stmt) -> bool:
    tested: ast.AST | None = None
    if isinstance(statement, (ast.If, ast.Assert)):
        tested = statement.test
    return tested is not None and any(isinstance(n, ast.Name) and n.id == "__name__" for n in ast.walk(tested))
