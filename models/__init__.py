"""The declarative models, one file each. Copy one, edit it, and pass it to `polar_bayes.fit`."""
