"""What a notebook shows of values of the package: everything that is in them, and no markup."""

import dataclasses

import pytest
from cases import each
from pages import EVIL, Page

import polar_bayes as pb
from polar_bayes.repr_html import DisplaySummary, HTMLRepr, Row, Table

VALUES = {
    "scene": pb.setups.SETUPS["goniometer"].scene,
    "set-up": pb.setups.SETUPS["goniometer"],
    "part": pb.RoughSurface(pb.GGX(), illumination=pb.Disc(half_width=5.0)),
    "coats": pb.physics.CoatStack((pb.ClearCoat(), pb.ThinFilm())),
    "link": pb.links.StokesLink(stated_errors=True),
    "method": pb.methods.Nuts(draws=700),
    "rung": pb.methods.Importance(),
    "model": pb.models.Hierarchical(),
    "pixels": pb.methods.CorrectedLaplace(),
    "priors": pb.PRIORS,
}


@each("value", VALUES.values(), ids=VALUES)
def test_a_card_is_balanced_html_and_runs_nothing(value) -> None:
    page = Page(value._repr_html_())
    assert page.open == []
    assert not {"script", "img", "link", "iframe"} & set(page.tags)
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    assert "object at" not in page.text


def test_a_scene_shows_its_parts_and_parameters() -> None:
    scene = pb.Scene(pb.RoughSurface(pb.GGX()), pb.Lambertian(albedo=0.25), pb.StokesMixing())
    text = Page(scene._repr_html_()).text
    for words in ("RoughSurface", "GGX", "Lambertian", "albedo 0.25", "coat none"):
        assert words in text
    for name in scene.parameters:
        assert name in text


@pytest.mark.thorough
def test_a_chosen_scene_is_shown_as_a_scene() -> None:
    scene = pb.setups.SETUPS["paper"].scene
    chosen = pb.scenes.ChosenScene(
        **{f.name: getattr(scene, f.name) for f in dataclasses.fields(pb.Scene)}
    )
    # In the sentence on the class, and in no field.
    text = Page(chosen._repr_html_()).text
    assert text.count("table of effects") == 1
    assert "ledger" not in text


def test_a_link_shows_what_it_reads() -> None:
    assert "reads concentration_scale" in Page(pb.links.BetaLink()._repr_html_()).text


def test_priors_show_their_numbers() -> None:
    text = Page(pb.PRIORS._repr_html_()).text
    assert "roughness roughness HalfNormal(scale=0.2)" in text


@pytest.mark.thorough
def test_text_stays_what_one_would_write() -> None:
    assert eval(repr(pb.Disc(half_width=5.0)), {"Disc": pb.Disc}) == pb.Disc(half_width=5.0)
    assert repr(pb.PRIORS) == repr(dict(pb.PRIORS))


def test_names_are_text_and_nothing_else() -> None:
    @dataclasses.dataclass(frozen=True)
    class Odd(HTMLRepr):
        """A <b>part</b> of one's own."""

        label: str = EVIL
        rows: object = dataclasses.field(default_factory=lambda: {EVIL: (EVIL, None)})
        parameters = (EVIL,)

    page = Page(Odd()._repr_html_())
    assert not {"script", "img", "b"} & set(page.tags)
    assert page.text.count(EVIL) == 4


def test_a_card_in_a_terminal() -> None:
    card = DisplaySummary(
        "leaf", ("All is well.",), (Table(("name", "mean"), (Row("n", ("1.5",)),)),)
    )
    assert repr(card) == "leaf\nAll is well.\n\nname  mean\nn      1.5"


# --- priors as a table ----------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_priors_of_a_set_up_are_those_that_its_fit_reads() -> None:
    table = pb.setups.prior_table("goniometer")
    setup = pb.setups.SETUPS["goniometer"]
    assert set(table.index) == {*setup.scene.parameters, "stokes_error_factor"}
    row = table.loc["refractive_index"]
    assert (row["symbol"], row["unit"]) == ("n", "1")
    assert 1.2 < row["q2.5"] < row["q50"] < row["q97.5"] < 2.0


@pytest.mark.thorough
def test_a_replaced_prior_stands_in_the_table() -> None:
    mine = {"roughness": pb.PRIORS["leakage"]}
    assert (
        pb.setups.prior_table("paper", priors=mine).loc["roughness", "prior"]
        == "HalfNormal(scale=0.01)"
    )
    assert set(pb.setups.prior_table().index) == set(pb.PRIORS)
    with pytest.raises(pb.FitError, match="no such parameter in this model"):
        pb.setups.prior_table(pb.Scene(pb.SmoothSurface()), priors=mine)
