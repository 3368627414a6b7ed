import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from spslam.evaluation.image_metrics import psnr_db, ssim

# Both compute in double precision.
TOLERANCE = 1e-9


def images(seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth image, and the same with noise."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:40, :60] / 10
    smooth = np.stack([np.sin(rows + k) * np.cos(columns * (k + 1)) for k in range(3)], axis=-1)
    smooth = 127 + 100 * smooth
    noisy = smooth + noise * generator.standard_normal(smooth.shape)
    return tuple(np.clip(image, 0, 255).round().astype(np.uint8) for image in (smooth, noisy))


def test_psnr_agrees_with_scikit_image():
    generator = np.random.default_rng(0)
    a, b = generator.integers(0, 256, (2, 20, 30, 3), dtype=np.uint8)
    assert psnr_db(a, b) == pytest.approx(peak_signal_noise_ratio(a, b))
    mask = generator.uniform(size=(20, 30)) > 0.5
    assert psnr_db(a, b, mask) == pytest.approx(peak_signal_noise_ratio(a[mask], b[mask]))
    assert psnr_db(a, a) == float("inf")
    assert np.isnan(psnr_db(a, b, np.zeros((20, 30), bool)))
    with pytest.raises(ValueError, match="psnr_db: rendered and reference must have the same shape"):
        psnr_db(a, b[:10])


SCIKIT = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255, "channel_axis": 2}


@pytest.mark.parametrize("noise", [1.0, 10.0, 60.0])
def test_ssim_agrees_with_scikit_image(noise):
    a, b = images(3, noise)
    assert ssim(a, b) == pytest.approx(structural_similarity(a, b, **SCIKIT), abs=TOLERANCE)
    assert ssim(a, b) == ssim(b, a)
    assert ssim(a, a) == pytest.approx(1, abs=TOLERANCE)


def test_ssim_with_a_mask_uses_pixels_whose_window_is_inside():
    a, b = images(4, 20.0)
    mask = np.zeros((40, 60), dtype=bool)
    mask[8:33, 10:45] = True
    _, full = structural_similarity(a, b, full=True, **SCIKIT)
    assert ssim(a, b, mask) == pytest.approx(full[13:28, 15:40].mean(), abs=TOLERANCE)
    changed = b.copy()
    changed[~mask] = 0
    assert ssim(a, changed, mask) == pytest.approx(ssim(a, b, mask), abs=TOLERANCE)
    assert np.isnan(ssim(a, b, np.zeros_like(mask)))
    assert np.isnan(ssim(a[:9], b[:9]))
    with pytest.raises(ValueError, match="ssim: rendered and reference must have the same shape"):
        ssim(a, b[:10])
