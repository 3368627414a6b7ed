// A tile of rows of a small network by one block: activations, parameters and their gradients in shared memory
// (mlp_layout.cuh), products in registers.
#pragma once

#include <cstdint>

#include "cuda/mlp_layout.cuh"
#include "kernels/decoders.h"

namespace spslam::mlp_tile {

// All steps but the first two and the last end with a __syncthreads().
template <class T>
class Tile {
 public:
  __device__ Tile(const Layout& layout, void* shared) : layout_(layout), shared_(static_cast<T*>(shared)) {}

  // Visible to the block after the next step.
  __device__ void load_network(const T* params) {
#pragma unroll
    for (int l = 0; l < kLayers; ++l) {
      const Layer& layer = layout_.layers[l];
      const int rows = padded(layer.outputs), stride = layer.stride();
      const T *weights = params + layer.flat_weights, *biases = params + layer.flat_biases;
      fill(rows * stride, [&](int i) {
        const int o = i / stride, k = i % stride;
        const bool inside = o < layer.outputs && k < layer.inputs;
        return Placed{layer.weights + i, inside ? __ldg(weights + o * layer.inputs + k) : T(0)};
      });
      fill(rows, [&](int o) { return Placed{layer.biases + o, o < layer.outputs ? __ldg(biases + o) : T(0)}; });
    }
  }

  // The same.
  __device__ void clear_sums() {
    for (int i = threadIdx.x; i < layout_.num_params; i += blockDim.x) shared_[layout_.sums + i] = T(0);
  }

  // The tile's inputs from [rows, inputs]; those of missing rows are 0.
  __device__ void load_rows(const T* input, int rows) {
    const Layer& first = layout_.layers[0];
    const int width = padded(first.inputs);
    fill(kRows<T> * width, [&](int i) {
      const int row = i / width, k = i % width;
      const bool inside = row < rows && k < first.inputs;
      return Placed{first.x + k * kStride<T> + row, inside ? __ldg(input + row * first.inputs + k) : T(0)};
    });
    __syncthreads();
  }

  // From the inputs to the outputs before their activation.
  __device__ void forward() {
    rectify_layer(layout_.layers[0]);
    __syncthreads();
    rectify_layer(layout_.layers[1]);
    __syncthreads();
    last_layer(layout_.layers[2]);
    __syncthreads();
  }

  __device__ void store_outputs(MlpActivation activation, T* out, int rows) const {
    const Layer& last = layout_.layers[kLayers - 1];
    store_rows(last.y, last.outputs, rows, out, [=](T y) { return activate(activation, y); });
  }

  // Replaces the outputs by gradients before the activation, from grad [rows, outputs] after it; 0 in missing rows.
  __device__ void activation_backward(MlpActivation activation, const T* grad, int rows) {
    const Layer& last = layout_.layers[kLayers - 1];
#pragma unroll 4
    for (int i = threadIdx.x; i < kRows<T> * last.outputs; i += blockDim.x) {
      const int row = i / last.outputs, o = i % last.outputs;
      T& y = shared_[last.y + o * kStride<T> + row];
      y = row < rows ? __ldg(grad + i) * activation_slope(activation, activate(activation, y)) : T(0);
    }
    __syncthreads();
  }

  // From the outputs' gradients to those of the parameters, which are added to the sums, and of the inputs: each
  // layer's take the place of its activations.
  __device__ void backward(bool need_params, bool need_input) {
#pragma unroll
    for (int l = kLayers - 1; l >= 0; --l) {
      const Layer& layer = layout_.layers[l];
      if (need_params) {
        add_weight_gradients(layer, l);
        __syncthreads();
      }
      if (l > 0 || need_input) input_gradients(layer, l > 0);
      __syncthreads();
    }
  }

  __device__ void store_input_gradients(T* grad_input, int rows) const {
    const Layer& first = layout_.layers[0];
    store_rows(first.x, first.inputs, rows, grad_input, [](T g) { return g; });
  }

  __device__ void store_sums(T* sums) const {
    for (int i = threadIdx.x; i < layout_.num_params; i += blockDim.x) sums[i] = shared_[layout_.sums + i];
  }

 private:
  static __device__ int lane() { return threadIdx.x % kWarp; }
  static __device__ int warp() { return threadIdx.x / kWarp; }
  static __device__ int warps() { return blockDim.x / kWarp; }

  // A value, and where it belongs in shared memory.
  struct Placed {
    int at;
    T value;
  };

  // Stores what load(i) reads for i in [0, count). A thread issues several reads before it uses the first.
  template <class F>
  __device__ void fill(int count, const F& load) {
    constexpr int kAtOnce = 8;
    const int threads = blockDim.x;
    for (int first = threadIdx.x; first < count; first += kAtOnce * threads) {
      Placed placed[kAtOnce];
#pragma unroll
      for (int j = 0; j < kAtOnce; ++j) {
        const int i = first + j * threads;
        placed[j] = i < count ? load(i) : Placed{-1, T(0)};
      }
#pragma unroll
      for (int j = 0; j < kAtOnce; ++j) {
        if (placed[j].at >= 0) shared_[placed[j].at] = placed[j].value;
      }
    }
  }

  __device__ Vector<T> vector(int at) const { return *reinterpret_cast<const Vector<T>*>(shared_ + at); }
  __device__ void put(int at, const Vector<T>& vector) { *reinterpret_cast<Vector<T>*>(shared_ + at) = vector; }
  // Where the lane's rows of a unit lie.
  static __device__ int rows_of(int activations, int unit) {
    return activations + unit * kStride<T> + lane() * kLaneRows<T>;
  }

  // y = relu(b + w x), 0 in the padding.
  __device__ void rectify_layer(const Layer& layer) {
    const int stride = layer.stride();
    for (int unit = kGroup * warp(); unit < layer.outputs; unit += kGroup * warps()) {
      T sums[kGroup][kLaneRows<T>];
#pragma unroll
      for (int i = 0; i < kGroup; ++i) {
#pragma unroll
        for (int r = 0; r < kLaneRows<T>; ++r) sums[i][r] = shared_[layer.biases + unit + i];
      }
      for (int k = 0; k < layer.inputs; k += kLaneRows<T>)
        add_products(layer.weights + unit * stride + k, stride, rows_of(layer.x, k), sums);
#pragma unroll
      for (int i = 0; i < kGroup; ++i) {
        Vector<T> y;
#pragma unroll
        for (int r = 0; r < kLaneRows<T>; ++r) y.v[r] = unit + i < layer.outputs ? rectified(sums[i][r]) : T(0);
        put(rows_of(layer.y, unit + i), y);
      }
    }
  }

  // The products of as many inputs as a vector of weights has.
  __device__ void add_products(int weights, int stride, int x, T (&sums)[kGroup][kLaneRows<T>]) const {
    Vector<T> w[kGroup];
#pragma unroll
    for (int i = 0; i < kGroup; ++i) w[i] = vector(weights + i * stride);
#pragma unroll
    for (int j = 0; j < kLaneRows<T>; ++j) {
      const Vector<T> rows = vector(x + j * kStride<T>);
#pragma unroll
      for (int i = 0; i < kGroup; ++i) {
#pragma unroll
        for (int r = 0; r < kLaneRows<T>; ++r) sums[i][r] += w[i].v[j] * rows.v[r];
      }
    }
  }

  // y = b + w x, one element per thread: there are few outputs, and so all warps have a share.
  __device__ void last_layer(const Layer& layer) {
    for (int i = threadIdx.x; i < kRows<T> * layer.outputs; i += blockDim.x) {
      const int o = i / kRows<T>, row = i % kRows<T>;
      const T* w = shared_ + layer.weights + o * layer.stride();
      const T* x = shared_ + layer.x + row;
      T sum = shared_[layer.biases + o];
#pragma unroll 8
      for (int k = 0; k < layer.inputs; ++k) sum += w[k] * x[k * kStride<T>];
      shared_[layer.y + o * kStride<T> + row] = sum;
    }
  }

  // x = w^T g for the gradients g of the layer's outputs, through the ReLU if x came out of one.
  __device__ void input_gradients(const Layer& layer, bool is_rectified) {
    for (int unit = kGroup * warp(); unit < layer.inputs; unit += kGroup * warps()) {
      T sums[kGroup][kLaneRows<T>] = {};
#pragma unroll 2
      for (int o = 0; o < layer.outputs; ++o) {
        const Vector<T> g = vector(rows_of(layer.y, o));
#pragma unroll
        for (int i = 0; i < kGroup; i += kLaneRows<T>) {
          const Vector<T> w = vector(layer.weights + o * layer.stride() + unit + i);
#pragma unroll
          for (int j = 0; j < kLaneRows<T>; ++j) {
#pragma unroll
            for (int r = 0; r < kLaneRows<T>; ++r) sums[i + j][r] += w.v[j] * g.v[r];
          }
        }
      }
#pragma unroll
      for (int i = 0; i < kGroup; ++i) {
        const int at = rows_of(layer.x, unit + i);
        Vector<T> x = vector(at);
#pragma unroll
        for (int r = 0; r < kLaneRows<T>; ++r) {
          x.v[r] = is_rectified ? rectified_gradient(x.v[r], sums[i][r]) : sums[i][r];
        }
        put(at, x);
      }
    }
  }

  // Each thread adds to a few parameters of its own. Warps start at a different place in each layer and block, as few
  // layers have work for all of them.
  __device__ void add_weight_gradients(const Layer& layer, int l) {
    const int output_blocks = (layer.outputs + kBlock - 1) / kBlock,
              input_blocks = (layer.inputs + kBlock - 1) / kBlock;
    const int blocks = output_blocks * input_blocks, threads = blockDim.x;
    for (int i = (threadIdx.x + kWarp * (blockIdx.x + l)) % threads; i < blocks + layer.outputs; i += threads) {
      if (i < blocks) {
        add_block(layer, i % output_blocks, output_blocks, i / output_blocks, input_blocks);
      } else {
        add_bias(layer, i - blocks);
      }
    }
  }

  // Outputs o, o + output_step, .. times inputs k, k + input_step, ..: neighboring threads read neighboring units.
  __device__ void add_block(const Layer& layer, int output, int output_step, int input, int input_step) {
    int outputs[kBlock], inputs[kBlock];  // those beyond the last repeat it, and are not stored
#pragma unroll
    for (int i = 0; i < kBlock; ++i) {
      outputs[i] = min(output + i * output_step, layer.outputs - 1);
      inputs[i] = min(input + i * input_step, layer.inputs - 1);
    }
    T sums[kBlock][kBlock] = {};
#pragma unroll 1
    for (int row = 0; row < kRows<T>; row += kLaneRows<T>) {
      Vector<T> g[kBlock], x[kBlock];
#pragma unroll
      for (int i = 0; i < kBlock; ++i) {
        g[i] = vector(layer.y + outputs[i] * kStride<T> + row);
        x[i] = vector(layer.x + inputs[i] * kStride<T> + row);
      }
#pragma unroll
      for (int i = 0; i < kBlock; ++i) {
#pragma unroll
        for (int j = 0; j < kBlock; ++j) {
#pragma unroll
          for (int r = 0; r < kLaneRows<T>; ++r) sums[i][j] += g[i].v[r] * x[j].v[r];
        }
      }
    }
    T* total = shared_ + layout_.sums + layer.flat_weights;
#pragma unroll
    for (int i = 0; i < kBlock; ++i) {
#pragma unroll
      for (int j = 0; j < kBlock; ++j) {
        const bool inside = output + i * output_step < layer.outputs && input + j * input_step < layer.inputs;
        if (inside) total[outputs[i] * layer.inputs + inputs[j]] += sums[i][j];
      }
    }
  }

  __device__ void add_bias(const Layer& layer, int output) {
    T sum = 0;
#pragma unroll 4
    for (int row = 0; row < kRows<T>; row += kLaneRows<T>) {
      const Vector<T> g = vector(layer.y + output * kStride<T> + row);
#pragma unroll
      for (int r = 0; r < kLaneRows<T>; ++r) sum += g.v[r];
    }
    shared_[layout_.sums + layer.flat_biases + output] += sum;
  }

  // out [rows, width] of f of the activations.
  template <class F>
  __device__ void store_rows(int activations, int width, int rows, T* out, const F& f) const {
    for (int i = threadIdx.x; i < rows * width; i += blockDim.x) {
      out[i] = f(shared_[activations + i % width * kStride<T> + i / width]);
    }
    __syncthreads();
  }

  const Layout& layout_;
  T* const shared_;
};

}  // namespace spslam::mlp_tile
