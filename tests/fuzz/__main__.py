"""Fuzzes the command line for as long as wanted and keeps what it finds.

python -m tests.fuzz --inputs 20000 --seed 1 --findings DIR
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.fuzz.fuzzing import fuzz


def main() -> int:
    """Returns 1 if an input broke a promise."""
    parser = argparse.ArgumentParser(description="Fuzz the command line with damaged files.")
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, help="folder for the inputs that broke a promise")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = fuzz(Path(folder), options.seed, options.first, options.inputs)
    for finding in result.findings:
        print(finding)
        if options.findings is not None:
            options.findings.mkdir(parents=True, exist_ok=True)
            file = finding.file.replace("/", "_")
            path = options.findings / f"{options.seed}-{finding.number}-{file}"
            path.write_bytes(finding.data)
    codes = ", ".join(f"{code}: {count:,}" for code, count in sorted(result.codes.items()))
    print(f"{result.inputs:,} inputs, {len(result.findings)} findings; exit codes {codes}")
    print(f"slowest {result.slowest_s:.2f} CPU-s, largest {result.largest_bytes / 1e9:.2f} GB")
    return 1 if result.findings else 0


if __name__ == "__main__":
    sys.exit(main())
