// Both decoders in shared memory, in the order in which the lanes of a warp read them, forward and transposed.
#pragma once

#include "cuda/fused/fragment.cuh"
#include "kernels/decoders.h"

namespace spslam::fused {

constexpr int kHidden = static_cast<int>(kDecoderHidden);
// Input slots of the geometry decoder, padded to whole fragments: the embedding, the position, a constant 1 for the
// first bias, zeros.
constexpr int kGeometrySlots = 16, kPositionSlot = 8, kOneSlot = 11;
constexpr int kGeometryInputs = static_cast<int>(kGeometryDecoder.input);
constexpr int kPlaneSlots = static_cast<int>(kPlaneChannels);
constexpr int kPositions = 3, kColors = 3;

// Where the layers begin in the flat parameters of the two decoders.
struct FlatDecoder {
  int b1, w2, b2, w3, b3, size;
};
constexpr FlatDecoder flat_decoder(const MlpShape& shape) {
  const MlpOffsets at = shape.offsets();
  return {static_cast<int>(at.b1), static_cast<int>(at.w2), static_cast<int>(at.b2),
          static_cast<int>(at.w3), static_cast<int>(at.b3), static_cast<int>(at.size)};
}
constexpr FlatDecoder kFlatGeometry = flat_decoder(kGeometryDecoder), kFlatColor = flat_decoder(kColorDecoder);

// Offsets in the image, in floats.
struct Image {
  static constexpr int geometry1 = 0, geometry2 = geometry1 + kGeometrySlots * kHidden;
  static constexpr int color1 = geometry2 + kHidden * kHidden, color2 = color1 + kPlaneSlots * kHidden;
  static constexpr int geometry1_back = color2 + kHidden * kHidden;
  static constexpr int geometry2_back = geometry1_back + kGeometrySlots * kHidden;
  static constexpr int color1_back = geometry2_back + kHidden * kHidden;
  static constexpr int color2_back = color1_back + kPlaneSlots * kHidden;
  static constexpr int geometry_bias2 = color2_back + kHidden * kHidden, geometry3 = geometry_bias2 + kHidden;
  static constexpr int color_bias1 = geometry3 + kHidden, color_bias2 = color_bias1 + kHidden;
  static constexpr int color3 = color_bias2 + kHidden, geometry_bias3 = color3 + kColors * kHidden;
  static constexpr int color_bias3 = geometry_bias3 + 1, size = color_bias3 + kColors;
};
static_assert(Image::size % 4 == 0);

// Channel of the texels in slot k: a lane's eight slots are two runs of four channels, which it loads at once.
__host__ __device__ constexpr int channel_of_slot(int k) {
  const int tile = k >> 3, quad = (k & 7) >> 1, odd = k & 1;
  return (tile >> 1) * 16 + 4 * quad + (tile & 1) * 2 + odd;
}

// Flat parameter that multiplies slot k of the geometry decoder's unit n; -1 for padding.
__host__ __device__ constexpr int geometry_parameter(int n, int k) {
  if (k < kPositionSlot) return n * kGeometryInputs + kPositions + k;
  if (k < kOneSlot) return n * kGeometryInputs + k - kPositionSlot;
  return k == kOneSlot ? kFlatGeometry.b1 + n : -1;
}

// Stores element (k, n) of a K x N matrix, and the same of its transpose.
template <Precision kPrecision>
__device__ __forceinline__ void put_weight(float* image, int forward, int back, int k, int n, int K, int N, float w) {
  if (kPrecision == Precision::kTf32) w = round_to_tf32(w);
  image[forward + fragment_index<kPrecision>(k, n, K, N)] = w;
  image[back + fragment_index<kPrecision>(n, k, N, K)] = w;
}

// Weights of one matrix that a thread copies from global to shared memory: all loads are issued before the first is
// used.
template <int kThreads, int kInputs>
struct MatrixShare {
  static constexpr int kCount = kInputs * kHidden, kShare = (kCount + kThreads - 1) / kThreads;
  float w[kShare];

  template <class Load>
  __device__ __forceinline__ void load(const Load& parameter) {
#pragma unroll
    for (int i = 0; i < kShare; ++i) {
      const int at = i * kThreads + static_cast<int>(threadIdx.x);
      w[i] = at < kCount ? parameter(at / kInputs, at % kInputs) : 0.0f;
    }
  }

  template <Precision kPrecision, class Slot>
  __device__ __forceinline__ void store(float* image, int forward, int back, const Slot& slot) const {
#pragma unroll
    for (int i = 0; i < kShare; ++i) {
      const int at = i * kThreads + static_cast<int>(threadIdx.x);
      if (at < kCount) {
        put_weight<kPrecision>(image, forward, back, slot(at % kInputs), at / kInputs, kInputs, kHidden, w[i]);
      }
    }
  }
};

// Slot of a texel channel, the inverse of channel_of_slot.
__host__ __device__ constexpr int slot_of_channel(int c) {
  const int quad = (c & 15) >> 2, low = c & 3;
  return ((c >> 4) * 2 + (low >> 1)) * 8 + 2 * quad + (low & 1);
}

// All threads of a block together; __syncthreads() must follow.
template <Precision kPrecision, int kThreads>
__device__ __forceinline__ void build_image(const float* geometry, const float* color, float* image) {
  MatrixShare<kThreads, kGeometrySlots> geometry1;
  MatrixShare<kThreads, kHidden> geometry2, color1, color2;
  geometry1.load([&](int n, int k) {
    const int at = geometry_parameter(n, k);
    return at < 0 ? 0.0f : geometry[at];
  });
  geometry2.load([&](int n, int k) { return geometry[kFlatGeometry.w2 + n * kHidden + k]; });
  color1.load([&](int n, int k) { return color[n * kPlaneSlots + k]; });
  color2.load([&](int n, int k) { return color[kFlatColor.w2 + n * kHidden + k]; });
  const auto same = [](int k) { return k; };
  geometry1.template store<kPrecision>(image, Image::geometry1, Image::geometry1_back, same);
  geometry2.template store<kPrecision>(image, Image::geometry2, Image::geometry2_back, same);
  color1.template store<kPrecision>(image, Image::color1, Image::color1_back, [](int c) { return slot_of_channel(c); });
  color2.template store<kPrecision>(image, Image::color2, Image::color2_back, same);
  for (int i = threadIdx.x; i < kColors * kHidden; i += kThreads) {
    image[Image::color3 + i] = color[kFlatColor.w3 + i];
    if (i < kHidden) {
      image[Image::geometry_bias2 + i] = geometry[kFlatGeometry.b2 + i];
      image[Image::geometry3 + i] = geometry[kFlatGeometry.w3 + i];
      image[Image::color_bias1 + i] = color[kFlatColor.b1 + i];
      image[Image::color_bias2 + i] = color[kFlatColor.b2 + i];
    }
    if (i < kColors) image[Image::color_bias3 + i] = color[kFlatColor.b3 + i];
    if (i == 0) image[Image::geometry_bias3] = geometry[kFlatGeometry.b3];
  }
}

}  // namespace spslam::fused
