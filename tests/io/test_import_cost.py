from __future__ import annotations

import subprocess
import sys


def test_importing_io_leaves_out_what_only_some_files_need() -> None:
    code = (
        "import sys\n"
        "import pnpdepth_cli.io.depth, pnpdepth_cli.io.visualisation, pnpdepth_cli.io.record\n"
        "import pnpdepth_cli.io.rgb\n"
        "print(sorted({'OpenEXR', 'PIL', 'torch', 'scipy'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "[]\n"
