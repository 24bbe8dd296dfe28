"""`python -m pnpdepth_cli` is `pnpdepth`, where the script is not on the path."""

from pnpdepth_cli.cli.main import main

main()
