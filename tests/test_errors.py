"""Errors that cross from one process to another."""

import pickle

from cases import each

from polar_bayes.errors import CaptureError, FitError, OutputError, PolarBayesError, SceneError


@each("kind", [PolarBayesError, CaptureError, FitError, OutputError, SceneError])
def test_an_error_arrives_as_it_was_sent(kind):
    sent = kind("it is\ntorn", where="view 3", hint="measure it again")
    came = pickle.loads(pickle.dumps(sent))
    assert type(came) is kind
    assert str(came) == str(sent) == "view 3: it is\\ntorn; measure it again"
    assert (came.what, came.where, came.hint) == (sent.what, sent.where, sent.hint)
