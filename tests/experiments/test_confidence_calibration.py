"""The fit of the error probability recovers the coefficients that the data were generated with."""

import numpy as np

from experiments.confidence_calibration import COLUMNS, coefficients


def test_coefficients_of_synthetic_poses():
    random = np.random.default_rng(0)
    table = np.stack(
        [
            random.uniform(0, 1, 20000),
            10 ** random.uniform(-4, -1, 20000),
            random.exponential(3, 20000),
            random.exponential(2, 20000),
            random.uniform(0, 0.3, 20000),
            random.uniform(-1, 1, 20000),  # brightness correlation is not part of the fit
        ],
        axis=1,
    )
    assert table.shape[1] == len(COLUMNS)
    prediction_error = np.log1p(table[:, 2] / 5 + table[:, 3] / 2.5)
    true = np.array([-2.0, -5.0, -1.5, 3.0, 12.0])
    odds = true @ [np.ones(len(table)), table[:, 0], np.log10(table[:, 1]), prediction_error, table[:, 4]]
    wrong = random.uniform(size=len(table)) < 1 / (1 + np.exp(-odds))
    found = coefficients(table[~wrong], table[wrong])
    # The ridge shrinks the slopes; the constant depends on the class frequencies and is not compared.
    np.testing.assert_allclose(found[1:], true[1:], rtol=0.25)
