"""`python -m manicm_ms.cli` is `manicm-ms`."""

from manicm_ms.cli import main

main()
