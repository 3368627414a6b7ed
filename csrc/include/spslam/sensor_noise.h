// The noise of a depth camera, measured while tracking from residuals against depth keyframes.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// Residuals are counted by depth, and differences of intensity by the gradient there: histograms of their sizes.
constexpr int kNoiseHistograms = 2, kNoiseBins = 32, kNoiseLevels = 128;
constexpr std::int64_t kNoiseCounts = std::int64_t{kNoiseHistograms} * kNoiseBins * kNoiseLevels;

// Compares the first num_pixels of a frame's pixels [., 3] at pose [7] with the depth keyframes, adds to counts
// [kNoiseCounts] and fits noise [kSensorNoiseSize] to them; older counts fade.
template <class Device>
void measure_noise(Device device, const std::int32_t* pixels, std::int64_t num_pixels, const float* pose,
                   const Intrinsics& intrinsics, const DepthKeyframes& keyframes, std::int32_t* counts, float* noise);

}  // namespace spslam
