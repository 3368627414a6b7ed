"""What the prior is for: the map is right after few mapping iterations (the paper's Fig. 7)."""

import functools

import numpy as np
import pytest

from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings
from tests.system.test_end_to_end import zero_crossing_errors

FRAMES = 15
# Of the paper's accuracy the strict form: the share of surface found within 1 cm, where the paper counts 5 cm.
NEAR_M = 0.01
EQUAL = 0.05
PAPERS_RATE = "mapping.embedding_rate=0.004"  # at a higher one fewer iterations are enough
WITHOUT_PRIOR = {
    "random embeddings": ("prior.enabled=false",),
    "random embeddings and decoder": ("prior.enabled=false", "prior.decoder=random", "mapping.decoder_rate=1e-3"),
}


@functools.cache
def accuracy(iterations, *overrides):
    """Share of the seen surface that the map places within 1 cm; as many iterations on the first frame as later."""
    dataset = Recorded(FRAMES)
    # A frame that does not fit must not be helped by others: ICP against them needs no map.
    sizes = (f"mapping.iterations={iterations}", f"mapping.first_iterations={iterations}")
    changes = (*sizes, PAPERS_RATE, "tracking.recovery=false", *overrides)
    system = SlamSystem(settings(*changes), dataset.camera, dataset.poses()[0])
    for frame in dataset:
        system.process(frame)
    system.finish()
    trajectory, scene = system.trajectory(), system.state.scene
    frames = dataset.frames[::5]
    errors = np.concatenate([zero_crossing_errors(scene, frame, dataset.camera, trajectory) for frame in frames])
    return float(np.mean(np.isfinite(errors) & (errors < NEAR_M)))


@pytest.mark.slow
def test_with_the_prior_ten_iterations_are_as_good_as_fifty():
    assert accuracy(10) == pytest.approx(accuracy(50), rel=EQUAL)
    assert accuracy(1) == pytest.approx(accuracy(50), rel=EQUAL)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", WITHOUT_PRIOR.values(), ids=WITHOUT_PRIOR)
def test_without_it_they_are_not(overrides):
    assert accuracy(10, *overrides) < (1 - EQUAL) * accuracy(50, *overrides)
    assert accuracy(10, *overrides) < 0.5 * accuracy(10)
    # Enough iterations make up for it.
    assert accuracy(50, *overrides) == pytest.approx(accuracy(50), rel=2 * EQUAL)
