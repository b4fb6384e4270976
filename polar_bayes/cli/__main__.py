"""`python -m polar_bayes.cli` is `polar-bayes`."""

from polar_bayes.cli.entry import console

if __name__ == "__main__":
    console()
