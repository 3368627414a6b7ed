"""The shipped weights keep the figures that their provenance claims, and the bars they were trained for."""

import pytest

from experiments.prior_accuracy import measure
from spslam.prior import load_prior
from spslam.prior.validation import validate

# Another processor's rounding moves the figures by far less.
REPRODUCED = 0.05
VIEWS = ((75, 80, 85),)


@pytest.mark.parametrize("neighborhood", [pytest.param(64, marks=pytest.mark.slow), 8])
def test_validation_figures_are_those_of_the_provenance(neighborhood):
    prior = load_prior(neighborhood=neighborhood)
    assert prior.neighborhood == neighborhood
    got = validate(prior.encoder_params, prior.decoder_params, prior.neighborhood, 0.0)
    for name in ("near_mae_mm", "far_mae_mm", "sign_accuracy", "zero_crossing_mm"):
        assert got["mean"][name] == pytest.approx(prior.metadata["validation"]["mean"][name], rel=REPRODUCED)


@pytest.mark.parametrize(
    ("noise_mm", "bar_mm"),
    [(2.0, 2.5), pytest.param(5.0, 2.5, marks=pytest.mark.slow), pytest.param(10.0, 5.0, marks=pytest.mark.slow)],
)
def test_surface_of_a_held_out_room_before_any_iteration(noise_mm, bar_mm):
    figures = measure(load_prior(), noise_mm, VIEWS)
    assert figures["mean_mm"] < bar_mm
    assert figures["found"] > 0.95
