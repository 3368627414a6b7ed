// A network of any width, layer after layer through global memory, one thread per unit.
#pragma once

#include "core/for_each.h"
#include "kernels/decoders.h"

namespace spslam::mlp_layers {

// Samples whose parameter gradients one thread sums, and the most partial sums per parameter.
constexpr std::int64_t kMinGradientChunk = 256, kMaxGradientChunks = 256;

inline std::int64_t gradient_chunk(std::int64_t n) {
  const std::int64_t share = chunk_count(n, kMaxGradientChunks);
  return share > kMinGradientChunk ? share : kMinGradientChunk;
}

// out[n, o] = relu or activation of w[o] . x[n] + b[o]
template <class T>
void layer(Cuda device, std::int64_t n, const T* x, std::int64_t inputs, const T* w, const T* b, std::int64_t outputs,
           bool rectify, MlpActivation activation, T* out) {
  for_each(device, n * outputs, [=] __device__(std::int64_t i) {
    const std::int64_t row = i / outputs, o = i % outputs;
    const T y = unit(w + o * inputs, x + row * inputs, inputs, b[o]);
    out[i] = rectify ? rectified(y) : activate(activation, y);
  });
}

// out[n, i] = sum_o g[n, o] w[o, i], through the ReLU before it where `active` is given.
template <class T>
void layer_backward(Cuda device, std::int64_t n, const T* g, std::int64_t outputs, const T* w, std::int64_t inputs,
                    const T* active, T* out) {
  for_each(device, n * inputs, [=] __device__(std::int64_t i) {
    const std::int64_t row = i / inputs, column = i % inputs;
    const T grad = input_gradient(g + row * outputs, w + column, outputs, inputs);
    out[i] = active ? rectified_gradient(active[i], grad) : grad;
  });
}

// Partial gradients of a layer's weights and biases: thread (chunk, o, i) sums over the samples of a chunk, in order.
template <class T>
void layer_weight_gradients(Cuda device, std::int64_t n, const T* g, std::int64_t outputs, const T* x,
                            std::int64_t inputs, std::int64_t num_params, T* weights, T* biases) {
  const std::int64_t chunk = gradient_chunk(n), columns = inputs + 1;
  for_each(device, chunk_count(n, chunk) * outputs * columns, [=] __device__(std::int64_t i) {
    const std::int64_t c = i / (outputs * columns), o = i / columns % outputs, column = i % columns;
    const std::int64_t end = (c + 1) * chunk < n ? (c + 1) * chunk : n;
    T sum = 0;
    for (std::int64_t row = c * chunk; row < end; ++row) {
      sum += g[row * outputs + o] * (column < inputs ? x[row * inputs + column] : T(1));
    }
    T* out = column < inputs ? weights + o * inputs + column : biases + o;
    out[c * num_params] = sum;
  });
}

inline std::int64_t workspace_size(const MlpShape& shape, std::int64_t n) {
  return 2 * n * shape.hidden;
}
inline std::int64_t backward_workspace_size(const MlpShape& shape, std::int64_t n) {
  return n * (4 * shape.hidden + shape.output) + chunk_count(n, gradient_chunk(n)) * shape.num_params();
}

template <class T>
void forward(Cuda device, const MlpShape& shape, const T* input, std::int64_t n, const T* params, T* workspace,
             T* out) {
  const MlpOffsets at = shape.offsets();
  T *h1 = workspace, *h2 = h1 + n * shape.hidden;
  layer(device, n, input, shape.input, params + at.w1, params + at.b1, shape.hidden, true, shape.activation, h1);
  layer(device, n, h1, shape.hidden, params + at.w2, params + at.b2, shape.hidden, true, shape.activation, h2);
  layer(device, n, h2, shape.hidden, params + at.w3, params + at.b3, shape.output, false, shape.activation, out);
}

template <class T>
void backward(Cuda device, const MlpShape& shape, const T* grad, const T* input, std::int64_t n, const T* params,
              T* workspace, T* grad_input, T* grad_params) {
  const MlpOffsets at = shape.offsets();
  const std::int64_t units = n * shape.hidden, num_params = shape.num_params();
  T *h1 = workspace, *h2 = h1 + units, *g1 = h2 + units, *g2 = g1 + units, *g3 = g2 + units,
    *partials = g3 + n * shape.output;
  forward(device, shape, input, n, params, workspace, g3);
  for_each(device, n * shape.output,
           [=] __device__(std::int64_t i) { g3[i] = grad[i] * activation_slope(shape.activation, g3[i]); });
  layer_backward(device, n, g3, shape.output, params + at.w3, shape.hidden, h2, g2);
  layer_backward(device, n, g2, shape.hidden, params + at.w2, shape.hidden, h1, g1);
  if (grad_input) {
    layer_backward(device, n, g1, shape.hidden, params + at.w1, shape.input, static_cast<const T*>(nullptr),
                   grad_input);
  }
  if (!grad_params) return;
  layer_weight_gradients(device, n, g1, shape.hidden, input, shape.input, num_params, partials + at.w1,
                         partials + at.b1);
  layer_weight_gradients(device, n, g2, shape.hidden, h1, shape.hidden, num_params, partials + at.w2, partials + at.b2);
  layer_weight_gradients(device, n, g3, shape.output, h2, shape.hidden, num_params, partials + at.w3, partials + at.b3);
  const std::int64_t chunks = chunk_count(n, gradient_chunk(n));
  for_each(device, num_params, [=] __device__(std::int64_t i) {
    T sum = 0;
    for (std::int64_t c = 0; c < chunks; ++c) sum += partials[c * num_params + i];
    grad_params[i] = sum;
  });
}

}  // namespace spslam::mlp_layers
