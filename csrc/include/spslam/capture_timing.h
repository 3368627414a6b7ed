// When a camera takes its images, measured while tracking: how much later than depth it takes color, and how long it
// reads a frame out.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// Of the delay of color and of the readout: s.
constexpr int kTimings = 2;
// What is known of each: the estimate (s) and the inverse of its variance (1/s^2).
constexpr int kTimingStateSize = 2 * kTimings;

// Bytes of scratch for the launch below.
template <class Device>
std::int64_t capture_timing_workspace_size(Device device, std::int64_t num_pixels, std::int64_t keyframes);

// Compares num_pixels of a frame's pixels [., 3] at pose [7] with the depth keyframes, whose color_delay is
// timing's, and moves state [kTimings, 2] towards the times at which depth and brightness agree best with one pose for
// each pair of frames. noise is [kSensorNoiseSize]. timing [kTimings] holds what is heeded already, and gets the
// estimates, 0 where they are too small to matter.
template <class Device>
void measure_capture_timing(Device device, const std::int32_t* pixels, std::int64_t num_pixels, const float* pose,
                            const Intrinsics& intrinsics, const float* noise, const DepthKeyframes& keyframes,
                            void* workspace, double* state, float* timing);

}  // namespace spslam
