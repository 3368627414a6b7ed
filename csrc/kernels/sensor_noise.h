// The maths of measuring a depth camera's noise: histograms of residuals against depth keyframes, and the model that
// fits their medians.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "kernels/depth_keyframes.h"
#include "kernels/gauss_newton.h"
#include "spslam/sensor_noise.h"

namespace spslam {

// Bins are quarters of an octave, levels eighths: the first bits of a float's mantissa.
constexpr int kBinShift = 21, kLevelShift = 20;
// Of depth (m) and of the gradient (1/px): the lower end of the first bin. Smaller ones belong to it too. A function,
// as device code cannot read arrays of the host.
SPS_INLINE constexpr float first_bin(int histogram) {
  return histogram == 0 ? 0.25f : 0x1p-9f;
}
// Of distances (m) and differences of intensity: the lower end of the first level.
SPS_INLINE constexpr float first_level(int histogram) {
  return histogram == 0 ? 0x1p-18f : 0x1p-15f;
}
// Of a bin, m^2; of [0, 1].
SPS_INLINE constexpr double least_variance(int histogram) {
  return histogram == 0 ? 1e-10 : static_cast<double>(kRoundingVariance);
}
// A residual adds so much, so that counts fade by whole numbers; after every frame they lose a share of 1/16.
constexpr std::int32_t kResidualCount = 256;
constexpr int kFadeShift = 4;
// Bins of fewer residuals say nothing, as their median may be anything; one of so many has half of the weight of one
// with many.
constexpr std::int64_t kLeastResiduals = 50;
constexpr double kHalfWeightResiduals = 200.0;
// Standard deviation of normal numbers over the median of their sizes.
constexpr float kDeviationsPerMedian = 1.4826f;
// Where the growth is determined by less than this, as all pixels have one depth, it stays nearly as it was: the share
// of its information that the floor leaves.
constexpr double kDeterminedShare = 0.01;

SPS_INLINE std::int32_t float_bits(float value) {
  std::int32_t bits;
  __builtin_memcpy(&bits, &value, sizeof(float));
  return bits;
}

SPS_INLINE float float_of_bits(std::int32_t bits) {
  float value;
  __builtin_memcpy(&value, &bits, sizeof(float));
  return value;
}

// Where a positive number lies among `count` steps of 2^shift ulps from `first` on; the ends take what is beyond.
SPS_INLINE int noise_step(float value, float first, int shift, int count) {
  const int step = (float_bits(value) >> shift) - (float_bits(first) >> shift);
  return step < 0 ? 0 : step < count ? step : count - 1;
}

// The number at `step` of them.
SPS_INLINE float noise_step_value(double step, float first, int shift) {
  const double whole = std::floor(step);
  const std::int32_t bits = ((float_bits(first) >> shift) + static_cast<std::int32_t>(whole)) << shift;
  const float low = float_of_bits(bits), high = float_of_bits(bits + (1 << shift));
  return low + static_cast<float>(step - whole) * (high - low);
}

SPS_INLINE std::int64_t noise_count_at(int histogram, float by, float residual) {
  const int bin = noise_step(by, first_bin(histogram), kBinShift, kNoiseBins);
  const int level = noise_step(std::fabs(residual), first_level(histogram), kLevelShift, kNoiseLevels);
  return (std::int64_t{histogram} * kNoiseBins + bin) * kNoiseLevels + level;
}

// Calls add(place in counts) for each residual of a pixel against a keyframe.
template <class Add>
SPS_INLINE void count_residuals(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe, const Pixel& pixel,
                                const PixelPoints& points, const Add& add) {
  const FrameProjection at =
      project_into_frame(keyframe.pose, keyframes.intrinsics, keyframes.height, keyframes.width, points.depth.world);
  if (!at.inside) return;
  const SurfaceDistance surface = surface_distance(keyframes, keyframe, at);
  if (!(surface.known && surface.near)) return;
  add(noise_count_at(0, pixel.depth, surface.value));
  if (!keyframe.intensities) return;
  const FrameProjection color_at = color_projection(keyframes, keyframe, points, at);
  if (!color_at.inside) return;
  const IntensityDifference difference = intensity_difference(keyframes, keyframe, color_at, luma(pixel.color));
  const float gradient = std::sqrt(difference.by_u * difference.by_u + difference.by_v * difference.by_v);
  add(noise_count_at(1, gradient, difference.value));
}

// What the residuals in a bin say: their variance and its weight, 0 without any.
struct BinVariance {
  double variance, weight;
};

SPS_INLINE BinVariance bin_variance(const std::int32_t* counts, int histogram) {
  std::int64_t total = 0;
  for (int level = 0; level < kNoiseLevels; ++level) total += counts[level];
  if (total < kLeastResiduals * kResidualCount) return {1.0, 0.0};
  std::int64_t below = 0;
  int level = 0;
  while (2 * (below + counts[level]) < total) below += counts[level++];
  const double within = (0.5 * static_cast<double>(total) - static_cast<double>(below)) / counts[level];
  const float median = noise_step_value(level + within, first_level(histogram), kLevelShift);
  const double deviation = static_cast<double>(kDeviationsPerMedian * median);
  const double variance = deviation * deviation + least_variance(histogram);
  const double residuals = static_cast<double>(total) / kResidualCount;
  return {variance, residuals / (residuals + kHalfWeightResiduals)};
}

// What the variance grows with: the fourth power of depth, the square of the gradient.
SPS_INLINE double noise_growth_of(int histogram, int bin) {
  const double by = static_cast<double>(noise_step_value(bin + 0.5, first_bin(histogram), kBinShift));
  return histogram == 0 ? by * by * by * by : by * by;
}

// floor and growth, neither negative, of least weighted sum of ((floor + growth t) / variance - 1)^2; as they were
// without residuals.
SPS_INLINE void fit_noise(const BinVariance* bins, int histogram, float* floor_and_growth) {
  double ones = 0.0, mixed = 0.0, squares = 0.0, by_one = 0.0, by_growth = 0.0;
  for (int b = 0; b < kNoiseBins; ++b) {
    const double one = 1.0 / bins[b].variance, growth = noise_growth_of(histogram, b) * one, w = bins[b].weight;
    ones += w * one * one;
    mixed += w * one * growth;
    squares += w * growth * growth;
    by_one += w * one;
    by_growth += w * growth;
  }
  if (!(ones > 0.0)) return;
  const double determinant = ones * squares - mixed * mixed, before = static_cast<double>(floor_and_growth[1]);
  double growth = 0.0, determined = 0.0;
  if (determinant > 1e-9 * ones * squares) {
    growth = (by_growth * ones - by_one * mixed) / determinant;
    const double share = determinant / (ones * squares);
    determined = share / (share + kDeterminedShare);
  }
  growth = (1.0 - determined) * before + determined * (growth > 0.0 ? growth : 0.0);
  double base = (by_one - growth * mixed) / ones;
  if (base < 0.0) base = 0.0, growth = by_growth / squares;
  floor_and_growth[0] = static_cast<float>(base);
  floor_and_growth[1] = static_cast<float>(growth);
}

}  // namespace spslam
