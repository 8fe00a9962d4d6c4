"""The pages of docs/results that benchmarks write; a checkout has them, an installation has not."""

from __future__ import annotations

from pathlib import Path

from manicm_ms.errors import ConfigError
from manicm_ms.paths import write_text

_ROOT = Path(__file__).resolve().parents[2]  # of the checkout, where the package is installed from one and editable


def results_page(name: str, root: Path = _ROOT) -> Path:
    """Return the file docs/results/`name` of the checkout at `root`; raise ConfigError where there is none.

    Ask for it before anything is measured: a refusal after minutes would come too late.
    """
    folder = root / "docs" / "results"
    if not (folder.is_dir() and (root / "setup.cfg").is_file()):
        raise ConfigError(
            f"--write keeps docs/results/{name} of a checkout, and manicm_ms is installed outside of one ({root}): "
            "leave --write out, the page is printed; or install a clone with 'pip install -e'"
        )
    return folder / name


def publish(text: str, page: Path | None) -> None:
    """Print a page, and keep it in the file `page` unless that is None."""
    print(text)
    if page is not None:
        write_text(page, text)
