"""Write what follows from the registered metrics into aveval(1).

python -m avcli.metrics            # write it
python -m avcli.metrics --check    # exit 1 if the manual differs from the metrics
"""

import argparse
import sys
from pathlib import Path

from avcli.metrics.description import with_score_list

MANUAL = Path(__file__).parents[2] / "man" / "aveval.1"


def main() -> int:
    """Write or check the manual; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m avcli.metrics", description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if the file would change")
    check = parser.parse_args().check
    page = MANUAL.read_text()
    written = with_score_list(page)
    if check and written != page:
        print(f"{MANUAL}: differs from the metrics; run python -m avcli.metrics", file=sys.stderr)
        return 1
    if written != page:
        MANUAL.write_text(written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
