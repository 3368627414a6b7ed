// Sums of the decoders' weight gradients over the tiles that the warps of a block have staged.
//
// Each warp owns part of the parameters and adds the tiles of all warps in order, so that the sums have a fixed order
// and need no atomics. One version for tensor cores, one in float.
#pragma once

#include "cuda/fused/arguments.cuh"
#include "cuda/fused/stage.cuh"

namespace spslam::fused {

// Flat parameter, counted over both decoders, that slot k feeds into unit n of the first layer; -1 for padding.
__device__ __forceinline__ int first_layer_parameter(bool color, int k, int n) {
  return color ? kFlatGeometry.size + n * kPlaneSlots + channel_of_slot(k) : geometry_parameter(n, k);
}
__device__ __forceinline__ int second_layer_parameter(bool color, int k, int n) {
  return (color ? kFlatGeometry.size + kFlatColor.w2 : kFlatGeometry.w2) + n * kHidden + k;
}

template <Precision kPrecision, int kWarps>
class WeightGradients;

// ---- tensor cores: 16-row strips of the matrices, activations transposed times deltas.

__device__ __forceinline__ std::uint32_t shared_address(const void* p) {
  return static_cast<std::uint32_t>(__cvta_generic_to_shared(p));
}

__device__ __forceinline__ void load_transposed(std::uint32_t address, std::uint32_t (&r)[4]) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
               : "r"(address)
               : "memory");
}

__device__ __forceinline__ void load_transposed(std::uint32_t address, std::uint32_t (&r)[2]) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x2.trans.shared.b16 {%0,%1}, [%2];"
               : "=r"(r[0]), "=r"(r[1])
               : "r"(address)
               : "memory");
}

template <int kWarps>
class WeightGradients<Precision::kTf32, kWarps> {
 public:
  using Tiles = Stage<Precision::kTf32>;

  // Adds one staged tile of every warp; `staged` says which decoders' tiles each has.
  __device__ __forceinline__ void add(const Tiles* tiles, const int* staged, int warp, int lane) {
#pragma unroll
    for (int owned = 0; owned < kOwned; ++owned) {
      const int strip = warp + kWarps * owned;
      if (strip < kOutputStrip) {
        add_hidden(tiles, staged, strip, lane, sums_[owned], biases_[owned]);
      } else {
        add_outputs(tiles, staged, lane, sums_[owned], biases_[owned]);
      }
    }
  }

  // Writes the sums of all parameters: each warp its own.
  __device__ __forceinline__ void store(float* partial, int warp, int lane) const {
#pragma unroll
    for (int owned = 0; owned < kOwned; ++owned) {
      const int strip = warp + kWarps * owned;
      if (strip < kOutputStrip) {
        store_hidden(partial, strip, lane, sums_[owned], biases_[owned]);
      } else {
        store_outputs_of(partial, lane, sums_[owned], biases_[owned]);
      }
    }
  }

 private:
  // 0: first geometry layer; 1, 2: second; 3, 4: first color layer; 5, 6: second; 7: both output layers.
  static constexpr int kStrips = 8, kOutputStrip = 7, kOwned = kStrips / kWarps;
  static constexpr int kElement = sizeof(__nv_bfloat16);

  static __device__ __forceinline__ bool is_color(int strip) { return strip >= 3; }
  static __device__ __forceinline__ bool is_first_layer(int strip) { return strip == 0 || strip == 3 || strip == 4; }
  static __device__ __forceinline__ int first_row(int strip) { return strip == 0 || strip % 2 ? 0 : kTileRows; }
  // The biases go with the first strip of a layer; that of the first geometry layer is a column of its matrix.
  static __device__ __forceinline__ bool has_bias(int strip) { return strip % 2 == 1; }

  __device__ __forceinline__ void add_hidden(const Tiles* tiles, const int* staged, int strip, int lane,
                                             float (&sums)[4][4], float (&biases)[4][4]) {
    const Tiles& first = tiles[0];
    const bool color = is_color(strip);
    const void *left, *right;
    if (is_first_layer(strip)) {
      left = color ? static_cast<const void*>(first.color_x) : first.geometry_x;
      right = color ? first.color_d1 : first.geometry_d1;
    } else {
      left = color ? first.color_h1 : first.geometry_h1;
      right = color ? first.color_d2 : first.geometry_d2;
    }
    const int matrix = lane >> 3, row = lane & 7;
    const int left_stride = (strip == 0 ? Tiles::kNarrow : Tiles::kWide) * kElement;
    const std::uint32_t left_at = shared_address(left) + (row + (matrix >> 1) * 8) * left_stride +
                                  (first_row(strip) + (matrix & 1) * 8) * kElement;
    const std::uint32_t right_at =
        shared_address(right) + (row + (matrix & 1) * 8) * Tiles::kWide * kElement + (matrix >> 1) * 8 * kElement;
    const int wanted = color ? kStagedColor : kStagedGeometry;
#pragma unroll 2
    for (int w = 0; w < kWarps; ++w) {
      if (!(staged[w] & wanted)) continue;
      const std::uint32_t offset = w * sizeof(Tiles);
      std::uint32_t a[4], b[4], c[4];
      load_transposed(left_at + offset, a);
      load_transposed(right_at + offset, b);
      load_transposed(right_at + offset + 16 * kElement, c);
      mma_bf16(sums[0], a, b[0], b[1]);
      mma_bf16(sums[1], a, b[2], b[3]);
      mma_bf16(sums[2], a, c[0], c[1]);
      mma_bf16(sums[3], a, c[2], c[3]);
      if (has_bias(strip)) {
        const std::uint32_t ones[4] = {kOne, kOne, kOne, kOne};
        mma_bf16(biases[0], ones, b[0], b[1]);
        mma_bf16(biases[1], ones, b[2], b[3]);
        mma_bf16(biases[2], ones, c[0], c[1]);
        mma_bf16(biases[3], ones, c[2], c[3]);
      }
    }
  }

  __device__ __forceinline__ void add_outputs(const Tiles* tiles, const int* staged, int lane, float (&sums)[4][4],
                                              float (&biases)[4][4]) {
    const int matrix = lane >> 3, row = lane & 7;
#pragma unroll
    for (int decoder = 0; decoder < 2; ++decoder) {
      const void* left = decoder ? tiles[0].color_h2 : tiles[0].geometry_h2;
      const void* right = decoder ? tiles[0].color_d3 : tiles[0].geometry_d3;
      const std::uint32_t left_at =
          shared_address(left) + (row + (matrix >> 1) * 8) * Tiles::kWide * kElement + (matrix & 1) * 8 * kElement;
      const std::uint32_t right_at = shared_address(right) + (lane & 15) * Tiles::kOut * kElement;
      for (int w = 0; w < kWarps; ++w) {
        if (!(staged[w] & (decoder ? kStagedColor : kStagedGeometry))) continue;
        const std::uint32_t offset = w * sizeof(Tiles);
        const std::uint32_t ones[4] = {kOne, kOne, kOne, kOne};
        std::uint32_t a[4], b[2];
        load_transposed(right_at + offset, b);
        load_transposed(left_at + offset, a);
        mma_bf16(sums[2 * decoder], a, b[0], b[1]);
        load_transposed(left_at + offset + 16 * kElement, a);
        mma_bf16(sums[2 * decoder + 1], a, b[0], b[1]);
        mma_bf16(biases[decoder], ones, b[0], b[1]);
      }
    }
  }

  static __device__ __forceinline__ void store_hidden(float* partial, int strip, int lane, const float (&sums)[4][4],
                                                      const float (&biases)[4][4]) {
    const bool color = is_color(strip);
#pragma unroll
    for (int j = 0; j < 4; ++j) {
#pragma unroll
      for (int e = 0; e < 4; ++e) {
        const int k = first_row(strip) + lane_row(lane) + 8 * (e >> 1), n = 8 * j + 2 * lane_quad(lane) + (e & 1);
        const int at = is_first_layer(strip) ? first_layer_parameter(color, k, n) : second_layer_parameter(color, k, n);
        if (at >= 0) partial[at] = sums[j][e];
        if (has_bias(strip) && lane_row(lane) == 0 && e < 2) partial[bias_parameter(strip) + n] = biases[j][e];
      }
    }
  }

  static __device__ __forceinline__ int bias_parameter(int strip) {
    if (!is_color(strip)) return kFlatGeometry.b2;
    return kFlatGeometry.size + (is_first_layer(strip) ? kFlatColor.b1 : kFlatColor.b2);
  }

  static __device__ __forceinline__ void store_outputs_of(float* partial, int lane, const float (&sums)[4][4],
                                                          const float (&biases)[4][4]) {
#pragma unroll
    for (int decoder = 0; decoder < 2; ++decoder) {
      const int outputs = decoder ? kColors : 1;
      const int weights = decoder ? kFlatGeometry.size + kFlatColor.w3 : kFlatGeometry.w3;
      const int bias = decoder ? kFlatGeometry.size + kFlatColor.b3 : kFlatGeometry.b3;
#pragma unroll
      for (int e = 0; e < 4; ++e) {
        const int o = 2 * lane_quad(lane) + (e & 1);
        if (o >= outputs) continue;
#pragma unroll
        for (int half = 0; half < 2; ++half) {
          const int k = kTileRows * half + lane_row(lane) + 8 * (e >> 1);
          partial[weights + o * kHidden + k] = sums[2 * decoder + half][e];
        }
        if (lane_row(lane) == 0 && e < 2) partial[bias + o] = biases[decoder][e];
      }
    }
  }

  static constexpr std::uint32_t kOne = 0x3F803F80u;  // two ones in bf16
  float sums_[kOwned][4][4] = {}, biases_[kOwned][4][4] = {};
};

// ---- float: lane n holds unit n, its warp some neighboring rows of the matrices.

template <int kWarps>
class WeightGradients<Precision::kFp32, kWarps> {
 public:
  using Tiles = Stage<Precision::kFp32>;

  __device__ __forceinline__ void add(const Tiles* tiles, const int* staged, int warp, int lane) {
    for (int w = 0; w < kWarps; ++w) {
      const Tiles& t = tiles[w];
      if (staged[w] & kStagedGeometry) {
        add_layer(t.geometry_x, t.geometry_d1, warp, lane, geometry1_);
        add_layer(t.geometry_h1, t.geometry_d2, warp, lane, geometry2_);
        add_outputs<1>(t.geometry_h2, t.geometry_d3, 0, warp, lane);
        add_bias(t.geometry_d2, 0, warp, lane);
      }
      if (staged[w] & kStagedColor) {
        add_layer(t.color_x, t.color_d1, warp, lane, color1_);
        add_layer(t.color_h1, t.color_d2, warp, lane, color2_);
        add_outputs<kColors>(t.color_h2, t.color_d3, 1, warp, lane);
        add_bias(t.color_d1, 1, warp, lane);
        add_bias(t.color_d2, 2, warp, lane);
      }
    }
  }

  __device__ __forceinline__ void store(float* partial, int warp, int lane) const {
    store_layer(geometry1_, warp, [&](int k, float sum) { put(partial, geometry_parameter(lane, k), sum); });
    store_layer(geometry2_, warp, [&](int k, float sum) { partial[second_layer_parameter(false, k, lane)] = sum; });
    store_layer(color1_, warp, [&](int k, float sum) { partial[first_layer_parameter(true, k, lane)] = sum; });
    store_layer(color2_, warp, [&](int k, float sum) { partial[second_layer_parameter(true, k, lane)] = sum; });
    constexpr int kBiases[3] = {kFlatGeometry.b2, kFlatGeometry.size + kFlatColor.b1,
                                kFlatGeometry.size + kFlatColor.b2};
#pragma unroll
    for (int b = 0; b < 3; ++b) {
      if (b % kWarps == warp) partial[kBiases[b] + lane] = hidden_biases_[b / kWarps];
    }
#pragma unroll
    for (int o = 0; o < kOutputs; ++o) {
      if (o % kWarps != warp) continue;
      const int weights = o ? kFlatGeometry.size + kFlatColor.w3 + (o - 1) * kHidden : kFlatGeometry.w3;
      const int bias = o ? kFlatGeometry.size + kFlatColor.b3 + o - 1 : kFlatGeometry.b3;
      partial[weights + lane] = outputs_[o / kWarps];
      if (lane == 0) partial[bias] = output_biases_[o / kWarps];
    }
  }

 private:
  static constexpr int kOutputs = 1 + kColors;
  static constexpr int share(int count) { return (count + kWarps - 1) / kWarps; }

  static __device__ __forceinline__ void put(float* partial, int at, float sum) {
    if (at >= 0) partial[at] = sum;
  }

  template <int kStride, int kRows>
  static __device__ __forceinline__ void add_layer(const float (&x)[kTileRows][kStride],
                                                   const float (&d)[kTileRows][Tiles::kWide], int warp, int lane,
                                                   float (&sums)[kRows]) {
    static_assert(kRows % 4 == 0, "rows are read four at a time");
    for (int row = 0; row < kTileRows; ++row) {
      const float delta = d[row][lane];
#pragma unroll
      for (int i = 0; i < kRows; i += 4) {
        const float4 v = *reinterpret_cast<const float4*>(&x[row][kRows * warp + i]);
        sums[i] += v.x * delta, sums[i + 1] += v.y * delta, sums[i + 2] += v.z * delta, sums[i + 3] += v.w * delta;
      }
    }
  }

  __device__ __forceinline__ void add_bias(const float (&d)[kTileRows][Tiles::kWide], int bias, int warp, int lane) {
    if (bias % kWarps != warp) return;
    for (int row = 0; row < kTileRows; ++row) hidden_biases_[bias / kWarps] += d[row][lane];
  }

  template <int kCount>
  __device__ __forceinline__ void add_outputs(const float (&h)[kTileRows][Tiles::kWide],
                                              const float (&d)[kTileRows][Tiles::kOut], int first, int warp, int lane) {
#pragma unroll
    for (int o = 0; o < kCount; ++o) {
      if ((first + o) % kWarps != warp) continue;
      for (int row = 0; row < kTileRows; ++row) {
        outputs_[(first + o) / kWarps] += h[row][lane] * d[row][o];
        output_biases_[(first + o) / kWarps] += d[row][o];
      }
    }
  }

  template <int kRows, class Store>
  static __device__ __forceinline__ void store_layer(const float (&sums)[kRows], int warp, const Store& store) {
#pragma unroll
    for (int i = 0; i < kRows; ++i) store(kRows * warp + i, sums[i]);
  }

  float geometry1_[kGeometrySlots / kWarps] = {}, geometry2_[kHidden / kWarps] = {};
  float color1_[kPlaneSlots / kWarps] = {}, color2_[kHidden / kWarps] = {};
  float hidden_biases_[share(3)] = {}, outputs_[share(kOutputs)] = {}, output_biases_[share(kOutputs)] = {};
};

}  // namespace spslam::fused
