"""What the automatic choice did and why, in sentences."""

import xarray as xr

from polar_bayes.inference.files import check_fit
from polar_bayes.inference.result import provenance_of


def auto_sentences(result: xr.DataTree) -> list[str]:
    """What `method="auto"` tried, what it took, and why.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A sentence for each method that was tried, in order; none for a fit by a method of one's
        own choice.

    Raises:
        FitError: It is no fit, or does not hold together.
    """
    check_fit(result)
    told = provenance_of(result).get("auto")
    if not told:
        return []
    sentences = []
    for step in told["steps"]:
        took = f"{step['name']} ({step['seconds']:.1f} s)"
        if step["taken"]:
            error = step.get("monte_carlo")
            within = "an unknown number of" if error is None else f"{error:.2g}"
            sentences.append(
                f"{took} was taken: its means and standard deviations are expected within "
                f"{within} posterior sd, and {told['tolerance']:g} were asked for."
            )
        else:
            sentences.append(f"{took} was not taken: {step['why']}.")
    if not told["met"]:
        sentences.append(
            f"Nothing was good enough; these are the numbers of {told['chosen']}, which came "
            "nearest. Give more seconds or a larger tolerance, or doubt them."
        )
    return sentences
