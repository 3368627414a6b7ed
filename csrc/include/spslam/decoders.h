// The small networks that turn interpolated features into SDF and color: input -> hidden -> hidden -> output, ReLU
// between.
//
// Parameters lie flat: W1 [hidden, input], b1, W2 [hidden, hidden], b2, W3 [output, hidden], b3, row-major.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

enum class MlpActivation : std::int32_t { kNone = 0, kTanh = 1, kSigmoid = 2 };

// Where the matrices and biases begin in the flat parameters.
struct MlpOffsets {
  std::int64_t w1, b1, w2, b2, w3, b3, size;
};

struct MlpShape {
  std::int64_t input, hidden, output;
  MlpActivation activation;

  constexpr MlpOffsets offsets() const {
    const std::int64_t b1 = hidden * input, w2 = b1 + hidden;
    const std::int64_t b2 = w2 + hidden * hidden, w3 = b2 + hidden, b3 = w3 + output * hidden;
    return {0, b1, w2, b2, w3, b3, b3 + output};
  }
  constexpr std::int64_t num_params() const { return offsets().size; }
};

// Scratch of the launches below for n samples, in elements of T.
template <class Device>
std::int64_t mlp_workspace_size(Device device, const MlpShape& shape, std::int64_t n);
template <class Device>
std::int64_t mlp_backward_workspace_size(Device device, const MlpShape& shape, std::int64_t n);

// out [n, output] = network(input [n, input]).
template <class Device, class T>
void mlp(Device device, const MlpShape& shape, const T* input, std::int64_t n, const T* params, T* workspace, T* out);

// grad_input [n, input] and grad_params [num_params] from grad [n, output]; either may be null. Sums over samples have
// a fixed order, whatever the number of threads.
template <class Device, class T>
void mlp_backward(Device device, const MlpShape& shape, const T* grad, const T* input, std::int64_t n, const T* params,
                  T* workspace, T* grad_input, T* grad_params);

}  // namespace spslam
