"""Entry point of `python -m polar_bayes.cli`, which is the program `polar-bayes`."""

from polar_bayes.cli.entry import console

if __name__ == "__main__":
    console()
