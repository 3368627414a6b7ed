// What the measured noise of a sensor means for a pixel's residuals: their weights.
#pragma once

#include <cmath>

#include "core/macros.h"
#include "core/math.h"
#include "core/vec.h"
#include "kernels/depth_noise.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// m, of the map's surface, and at most of a keyframe's, beside the noise of a pixel that grows with depth.
constexpr float kSurfaceDeviation = 0.003f;
// m, of a keyframe's surface at least.
constexpr float kLeastSurfaceDeviation = 0.0001f;
// A difference of intensities of one deviation counts as so many of a keyframe's surface.
constexpr float kIntensityGain = 2.0f;
// Of [0, 1]: that of the rounding of two intensities to 8 bits.
constexpr float kRoundingVariance = 2.6e-6f;
// px, of images that are registered: what remains is alike for few pixels only.
constexpr float kRegistrationError = 0.3f;
// Width of the robust kernel of intensities, in deviations.
constexpr float kRobustDeviations = 3.0f;

SPS_INLINE SensorNoise load_sensor_noise(const float* numbers) {
  return {{numbers[0], numbers[1]}, numbers[2], numbers[3]};
}

// Of a difference between intensities where the image has these derivatives (1/px). Never 0, whatever was measured: a
// flat pixel would weigh infinitely.
SPS_INLINE float intensity_deviation(const SensorNoise* noise, float by_u, float by_v) {
  const float floor = larger(noise->intensity_floor, kRoundingVariance);
  return std::sqrt(floor + noise->intensity_growth * (by_u * by_u + by_v * by_v));
}

// Share of the weight of intensities: images that are not registered are so alike for neighboring pixels, and that does
// not average out, so their deviation counts twice.
SPS_INLINE float intensity_share(const SensorNoise& noise) {
  constexpr float kRegistered = kRegistrationError * kRegistrationError;
  return kRegistered / larger(noise.intensity_growth, kRegistered);
}

// m^2, the variance of the nearest pixels of a keyframe's surface.
SPS_INLINE float surface_variance(const SensorNoise& noise) {
  constexpr float kMost = kSurfaceDeviation * kSurfaceDeviation,
                  kLeast = kLeastSurfaceDeviation * kLeastSurfaceDeviation;
  return smaller(kLeast + noise.depth.floor, kMost);
}

// m that a difference of intensities of one deviation counts as.
SPS_INLINE float intensity_meters(const SensorNoise& noise) {
  return kIntensityGain * std::sqrt(surface_variance(noise) * intensity_share(noise));
}

// Of a pixel of one depth and intensity: inverse variances of its residuals, against the map as a share of that without
// noise, against a keyframe as a share of that of the nearest pixels.
struct PixelNoise {
  const SensorNoise* sensor;  // null where the noise is not known
  float map_certainty, keyframe_certainty;
  float intensity;
  float intensity_meters;
};

SPS_INLINE PixelNoise pixel_noise(const SensorNoise* sensor, float depth, float intensity) {
  if (!sensor) return {nullptr, 1.0f, 1.0f, intensity, 0.0f};
  constexpr float kMost = kSurfaceDeviation * kSurfaceDeviation,
                  kLeast = kLeastSurfaceDeviation * kLeastSurfaceDeviation;
  const float variance = depth_variance(sensor->depth, depth);
  const float surface = surface_variance(*sensor);
  return {sensor, kMost / (kMost + variance), surface / larger(kLeast + variance, surface), intensity,
          intensity_meters(*sensor)};
}

}  // namespace spslam
