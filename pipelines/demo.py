"""`make demo`: nothing in, a small data set from embedded streets and the path of a picture of it out.

Every step is the command that a user would type, printed before it runs.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

OUT = Path("augkitti-demo")
PICTURE = Path("augkitti-demo.png")


def main() -> int:
    """Generate, split, validate, draw; the first exit code that is not 0, else 0."""
    if (OUT / "dataset.json").is_file():  # of an earlier demo
        shutil.rmtree(OUT)
    out = str(OUT)
    environment = {name: value for name, value in os.environ.items() if name != "AUGKITTI_KITTI"}
    for words in (
        ["generate", "--n", "20", "--jobs", "2", "--out", out],
        ["split", out],
        ["validate", out, "--jobs", "2"],
        ["view", out, "--out", str(PICTURE)],
    ):
        print(f"\n$ augkitti {' '.join(words)}", flush=True)
        code = subprocess.run([sys.executable, "-m", "pipelines", *words], check=False, env=environment).returncode
        if code:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
