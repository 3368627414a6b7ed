// Where a network and a tile of its rows lie in a block's shared memory.
// Activations are [unit][kStride], so that a lane has its rows of a unit in one vector, and the warp all of them.
// Weights are [output][input] as among the parameters, but padded with zeros to whole groups of units both ways.
#pragma once

#include <algorithm>
#include <cstdint>

#include "cuda/fused/fragment.cuh"
#include "spslam/decoders.h"

namespace spslam::mlp_tile {

using fused::kWarp;

constexpr int kMinWarps = 4, kMaxWarps = 8;
constexpr int kGroup = 8;  // units that a warp computes at a time
constexpr int kBlock = 4;  // a thread's share of a weight matrix's gradients: kBlock x kBlock
constexpr int kLayers = 3;
constexpr int kVectorBytes = 16;

template <class T>
constexpr int kLaneRows = kVectorBytes / static_cast<int>(sizeof(T));
template <class T>
constexpr int kRows = kWarp * kLaneRows<T>;
// An odd number of vectors, so that neighboring units begin in different banks.
template <class T>
constexpr int kStride = kRows<T> + kLaneRows<T>;

template <class T>
struct alignas(kVectorBytes) Vector {
  T v[kLaneRows<T>];
};

__host__ __device__ constexpr int padded(int width) {
  return (width + kGroup - 1) / kGroup * kGroup;
}

struct Layer {
  int inputs, outputs;
  int x, y;                       // where its activations lie in shared memory, in elements
  int weights, biases;            // and its parameters
  int flat_weights, flat_biases;  // and where they lie among all parameters
  __host__ __device__ constexpr int stride() const { return padded(inputs); }
};

struct Layout {
  Layer layers[kLayers];
  int num_params;
  int sums;  // of the parameters' gradients, flat
  int size;  // elements in all

  __host__ __device__ int inputs() const { return layers[0].inputs; }
  __host__ __device__ int outputs() const { return layers[kLayers - 1].outputs; }
  template <class T>
  int bytes() const {
    return size * static_cast<int>(sizeof(T));
  }
  // As many warps as the hidden layers have work for.
  int warps() const { return std::min(std::max(padded(layers[0].outputs) / kGroup, kMinWarps), kMaxWarps); }
};

// The layout must not overflow an int.
template <class T>
Layout make_layout(const MlpShape& shape, bool gradients) {
  const MlpOffsets at = shape.offsets();
  const int input = static_cast<int>(shape.input), hidden = static_cast<int>(shape.hidden),
            output = static_cast<int>(shape.output);
  Layout layout{};
  const auto take = [&](int size) { return (layout.size += size) - size; };
  const auto activations = [&](int width) { return take(padded(width) * kStride<T>); };
  int places[kLayers + 1];
  if (gradients) {
    places[0] = activations(input), places[1] = activations(hidden);
    places[2] = activations(hidden), places[3] = activations(output);
  } else {  // two buffers in turn
    places[0] = places[2] = activations(input > hidden ? input : hidden);
    places[1] = places[3] = activations(output > hidden ? output : hidden);
  }
  const int widths[kLayers + 1] = {input, hidden, hidden, output};
  const std::int64_t flat[kLayers][2] = {{at.w1, at.b1}, {at.w2, at.b2}, {at.w3, at.b3}};
  for (int l = 0; l < kLayers; ++l) {
    Layer& layer = layout.layers[l];
    layer.inputs = widths[l], layer.outputs = widths[l + 1];
    layer.x = places[l], layer.y = places[l + 1];
    layer.weights = take(padded(layer.outputs) * layer.stride());
    layer.biases = take(padded(layer.outputs));
    layer.flat_weights = static_cast<int>(flat[l][0]), layer.flat_biases = static_cast<int>(flat[l][1]);
  }
  layout.num_params = static_cast<int>(at.size);
  layout.sums = gradients ? take(layout.num_params) : 0;
  return layout;
}

}  // namespace spslam::mlp_tile
