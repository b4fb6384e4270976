"""`python -m polar_bayes.cli` is `polar-bayes`."""

import sys

from polar_bayes.cli.entry import main

if __name__ == "__main__":
    sys.exit(main())
