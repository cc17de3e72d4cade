"""`python -m reconstruction`: the same command as `jaxcal reconstruct`, for those who come from e2calib."""

import sys

from jaxcal.cli import main

if __name__ == "__main__":
    main(["reconstruct", *sys.argv[1:]], prog_name="jaxcal")
