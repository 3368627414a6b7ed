// Front-to-back alpha compositing of rays, as of NeRF, NeuS and VolSDF, with gradients.
//
// A ray has samples in the order in which light meets them. Sample i stops the share alpha_i of the light that reaches
// it, so its weight is w_i = alpha_i prod_{j < i} (1 - alpha_j). Sums have a fixed order.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// Where the samples of each ray lie: rows of equal length, or spans (first sample, number of samples) of one list.
struct RaySpans {
  const std::int64_t* packed_info;  // [R, 2], or null for rows of equal length
  std::int64_t num_rays, num_samples;
};

template <class T>
struct CompositeInputs {
  const T* opacities;  // [N] alpha, or densities if there are lengths
  const T* lengths;    // [N] or null
  const T* values;     // [N, channels]
  const T* t;          // [N]
  std::int64_t channels;
  T stop;  // samples that less than this share of the light reaches take no part
  RaySpans spans;
};

template <class T>
struct CompositeOutputs {
  T* values;   // [R, channels]
  T* depth;    // [R]
  T* opacity;  // [R]
  T* weights;  // [N]; of samples outside of all spans it is left as it is
};

// Of a loss by the outputs; that by the weights may be null.
template <class T>
struct CompositeOutputGradients {
  const T *values, *depth, *opacity, *weights;
};

// Of a loss by the inputs; that by the lengths is null if there are none.
template <class T>
struct CompositeInputGradients {
  T *opacities, *lengths, *values, *t;
};

// A ray whose span does not lie within the samples gets NaN.
template <class Device, class T>
void alpha_composite(Device device, const CompositeInputs<T>& inputs, const CompositeOutputs<T>& out);

// `weights` are those of the forward function.
template <class Device, class T>
void alpha_composite_backward(Device device, const CompositeInputs<T>& inputs, const T* weights,
                              const CompositeOutputGradients<T>& grad, const CompositeInputGradients<T>& out);

}  // namespace spslam
