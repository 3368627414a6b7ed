// Image features: corners of an image at several scales with binary descriptors (ORB), of which any prefix covers the
// image. On the host alone; the kernels' threads share an image (`set_num_threads`), unless another has them.
//
// Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011, with the numbers of OpenCV's `cv::ORB`
// (eight levels, each 1.2 times smaller; FAST of nine pixels, of which the best by Harris's measure are taken).
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

constexpr int kOrbBytes = 32;

struct OrbOptions {
  std::int32_t detected;      // corners at most, of all levels
  std::int32_t count;         // features at most: of the corners the strongest of each cell, then the second ones, ...
  std::int32_t cell_columns;  // of the grid of square cells over the image
  std::int32_t edge_px;       // without corners along the edge of each level; at least 16
  std::int32_t fast_threshold;  // gray levels
};

// Features of `intensity` [height, width]; writes `positions` [count, 2] (column and row in px) and `descriptors`
// [count, 32], and returns how many there are: the same for any number of threads. Throws std::bad_alloc.
std::int64_t orb_features(Cpu device, const std::uint8_t* intensity, std::int32_t height, std::int32_t width,
                          const OrbOptions& options, float* positions, std::uint8_t* descriptors);

}  // namespace spslam
