"""A fit is checked when it enters, and what is computed of it is computed once."""

from collections import Counter

import numpy as np
import pytest
import xarray as xr
from synthetic_results import make_result, pool

from polar_bayes.diagnostics import parameters
from polar_bayes.diagnostics.convergence import summary
from polar_bayes.diagnostics.view import view_of
from polar_bayes.errors import FitError
from polar_bayes.inference.files import Schema
from polar_bayes.reporting.plots_curves import curves
from polar_bayes.reporting.plots_fit import drawable
from polar_bayes.reporting.report import render

SMALL = {"wavelengths": (), "views": 12, "draws": 150, "variables": ("dop",)}


def test_a_view_is_its_own_view_and_a_tree_is_refused_by_name() -> None:
    fit = view_of(make_result(**SMALL))
    assert view_of(fit) is fit
    with pytest.raises(FitError, match="that one: it holds no fit"):
        view_of(xr.DataTree(), "that one")


def test_a_table_is_computed_once_for_a_view_and_anew_for_a_tree() -> None:
    result = make_result(**SMALL)
    fit = view_of(result)
    assert summary(fit) is summary(fit)
    assert summary(result) is not summary(result)


def test_what_has_arguments_is_computed_once_for_each_of_them() -> None:
    fit = view_of(make_result(**SMALL))
    assert drawable(fit, material=True) is drawable(fit, material=True)
    assert drawable(fit, material=True) != drawable(fit)
    assert curves(fit, "dop") is curves(fit, "dop")


def test_a_report_checks_its_fit_once_and_takes_the_posterior_apart_once(monkeypatch):
    result = pool(make_result(**SMALL, materials=("a", "b", "c")), "roughness")
    checked, taken = [], Counter[str]()
    check, entries = Schema.check, parameters._entries

    def counted_check(schema, tree, source) -> None:
        checked.append(tree is result)
        check(schema, tree, source)

    def counted_entries(variable, sample_dims):
        own = result["posterior"].data_vars.get(variable.name)
        if own is not None and np.shares_memory(variable.values, own.values):
            taken[variable.name] += 1
        return entries(variable, sample_dims)

    monkeypatch.setattr(Schema, "check", counted_check)
    monkeypatch.setattr(parameters, "_entries", counted_entries)
    render(result)
    assert checked == [True]
    assert taken == dict.fromkeys(result["posterior"].data_vars, 1)
