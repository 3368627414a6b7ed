// How bright a color is.
#pragma once

#include <cstdint>

namespace spslam {

// Weights of red, green and blue in an intensity (Rec. 601), in thousandths: whole numbers, so that means over many
// pixels can be summed exactly. Python reads them by the op luma_weights.
constexpr std::int64_t kLumaWeights[3] = {299, 587, 114};

}  // namespace spslam
