// SDF of a scene and its gradient for 16 points at a time by one warp (fused/fragment.cuh).
#pragma once

#include <cstdint>

#include "cuda/fused/fragment.cuh"
#include "kernels/decoders.h"
#include "kernels/interpolation.h"
#include "spslam/scene_view.h"

namespace spslam {

// The geometry decoder in shared memory. Its inputs are ordered embedding (8), scaled position (3), a constant 1 (for
// the first bias), and padded to 16.
template <Precision kPrecision>
class GeometryNetwork {
 public:
  // By all threads of a block, which must synchronize before the first use.
  __device__ void load(const float* params) {
    constexpr int kHidden = kDecoderHidden, kInputs = kGeometryDecoder.input;
    constexpr MlpOffsets kAt = kGeometryDecoder.offsets();
    const float *w1 = params + kAt.w1, *b1 = params + kAt.b1, *w2 = params + kAt.w2, *b2 = params + kAt.b2,
                *w3 = params + kAt.w3;
    for (int i = threadIdx.x; i < kPaddedInputs * kHidden; i += blockDim.x) {
      const int k = i / kHidden, n = i % kHidden;
      const float w = k < 8 ? w1[n * kInputs + 3 + k] : k < 11 ? w1[n * kInputs + k - 8] : k == 11 ? b1[n] : 0.0f;
      put(w1_, k, n, kPaddedInputs, kHidden, w);
      put(w1_transposed_, n, k, kHidden, kPaddedInputs, w);
    }
    for (int i = threadIdx.x; i < kHidden * kHidden; i += blockDim.x) {
      const int n = i / kHidden, k = i % kHidden;
      put(w2_, k, n, kHidden, kHidden, w2[i]);
      put(w2_transposed_, n, k, kHidden, kHidden, w2[i]);
    }
    for (int i = threadIdx.x; i < kHidden; i += blockDim.x) b2_[i] = b2[i], w3_[i] = w3[i];
    if (threadIdx.x == 0) b3_ = params[kAt.b3];
  }

  // sdf[r] of the lane's samples g and g + 8, the same in all four lanes of a sample; `active` says which ReLUs passed.
  __device__ void forward(const float (&x)[2][4], int lane, std::uint32_t (&active)[2], float (&sdf)[2]) const {
    float h1[4][4] = {}, h2[4][4];
    fused::layer<kPrecision>(w1_, x, h1, lane);
    active[0] = fused::rectify(h1);
    fused::fill_columns(h2, b2_, lane);
    fused::layer<kPrecision>(w2_, h1, h2, lane);
    active[1] = fused::rectify(h2);
    float y[2];
    fused::dot_rows(h2, w3_, lane, y);
#pragma unroll
    for (int r = 0; r < 2; ++r) sdf[r] = activate(MlpActivation::kTanh, y[r] + b3_);
  }

  // grad_x = slope[r] times the derivative of the value before the tanh by the network's inputs.
  __device__ void backward(const std::uint32_t (&active)[2], const float (&slope)[2], int lane,
                           float (&grad_x)[2][4]) const {
    float g2[4][4], g1[4][4] = {};
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const float2 w = output_weights(j, lane);
#pragma unroll
      for (int r = 0; r < 2; ++r) g2[j][2 * r] = slope[r] * w.x, g2[j][2 * r + 1] = slope[r] * w.y;
    }
    fused::mask(g2, active[1]);
    fused::layer<kPrecision>(w2_transposed_, g2, g1, lane);
    fused::mask(g1, active[0]);
#pragma unroll
    for (int j = 0; j < 2; ++j) grad_x[j][0] = grad_x[j][1] = grad_x[j][2] = grad_x[j][3] = 0.0f;
    fused::layer<kPrecision>(w1_transposed_, g1, grad_x, lane);
  }

 private:
  static constexpr int kPaddedInputs = 16;

  static __device__ void put(float* image, int k, int n, int inputs, int outputs, float weight) {
    if (kPrecision == Precision::kTf32) weight = fused::round_to_tf32(weight);
    image[fused::fragment_index<kPrecision>(k, n, inputs, outputs)] = weight;
  }

  __device__ float2 output_weights(int j, int lane) const {
    return *reinterpret_cast<const float2*>(w3_ + 8 * j + 2 * (lane % 4));
  }

  alignas(16) float w1_[kPaddedInputs * kDecoderHidden], w1_transposed_[kPaddedInputs * kDecoderHidden];
  alignas(16) float w2_[kDecoderHidden * kDecoderHidden], w2_transposed_[kDecoderHidden * kDecoderHidden];
  alignas(16) float b2_[kDecoderHidden], w3_[kDecoderHidden];
  float b3_;
};

// The lane's own value, or that of the neighboring lane with the quad's other sample.
__device__ __forceinline__ float of_sample(float own, bool is_own) {
  const float other = __shfl_xor_sync(fused::kAllLanes, own, 1);
  return is_own ? own : other;
}
__device__ __forceinline__ std::int32_t of_sample(std::int32_t own, bool is_own) {
  const std::int32_t other = __shfl_xor_sync(fused::kAllLanes, own, 1);
  return is_own ? own : other;
}
__device__ __forceinline__ Vec3<float> of_sample(const Vec3<float>& own, bool is_own) {
  return {of_sample(own.x, is_own), of_sample(own.y, is_own), of_sample(own.z, is_own)};
}

// values[r][e][k]: channel 2 q + e at corner k of sample r's cell, 0 outside. All loads are issued before the first is
// used.
__device__ __forceinline__ void load_corner_channels(const SceneView& scene, const std::int32_t (&voxels)[2], int q,
                                                     float (&values)[2][2][kCellCorners]) {
  int4 ids[2][2];
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const int4* row = reinterpret_cast<const int4*>(scene.corner_ids) + 2 * static_cast<std::int64_t>(voxels[r]);
#pragma unroll
    for (int half = 0; half < 2; ++half) ids[r][half] = voxels[r] >= 0 ? __ldg(row + half) : int4{0, 0, 0, 0};
  }
  const float2* rows = reinterpret_cast<const float2*>(scene.embeddings) + q;
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const int corners[kCellCorners] = {ids[r][0].x, ids[r][0].y, ids[r][0].z, ids[r][0].w,
                                       ids[r][1].x, ids[r][1].y, ids[r][1].z, ids[r][1].w};
#pragma unroll
    for (int k = 0; k < kCellCorners; ++k) {
      const float2 value = voxels[r] >= 0 ? __ldg(rows + kEmbeddingChannels / 2 * static_cast<std::int64_t>(corners[k]))
                                          : float2{0.0f, 0.0f};
      values[r][0][k] = value.x;
      values[r][1][k] = value.y;
    }
  }
}

// The sample of a tile that a lane holds: g for lanes 4 g and 4 g + 2, g + 8 for the other two.
__device__ __forceinline__ int lane_sample(int lane) {
  return lane / 4 + 8 * (lane % 2);
}

// SDF and gradient of the lane's own sample, at a world point in the cell of lowest vertex `voxel`; kNoVoxel for a
// sample outside, whose result is undefined.
template <Precision kPrecision>
__device__ __forceinline__ float geometry_tile(const SceneView& scene, const GeometryNetwork<kPrecision>& network,
                                               const Vec3<float>& point, const Vec3<float>& local, std::int32_t voxel,
                                               int lane, Vec3<float>& gradient) {
  const int q = lane % 4, own = lane % 2;
  const Vec3<float> inputs = scene.position_scale * Vec3<float>{point.x - scene.origin[0], point.y - scene.origin[1],
                                                                point.z - scene.origin[2]};
  Vec3<float> positions[2], locals[2];
  std::int32_t voxels[2];
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    positions[r] = of_sample(inputs, r == own);
    locals[r] = of_sample(local, r == own);
    voxels[r] = of_sample(voxel, r == own);
  }
  float values[2][2][kCellCorners];  // of the lane's two channels at the corners of both samples' cells
  load_corner_channels(scene, voxels, q, values);
  float x[2][4];
  Vec3<float> slopes[2][2];  // of the channels by the position in the cell
#pragma unroll
  for (int r = 0; r < 2; ++r) {
#pragma unroll
    for (int e = 0; e < 2; ++e) {
      float sum = 0.0f;
#pragma unroll
      for (int k = 0; k < kCellCorners; ++k) sum += trilinear_weight(locals[r], k) * values[r][e][k];
      x[0][2 * r + e] = sum;
      slopes[r][e] = trilinear_gradient(locals[r], values[r][e]);
    }
    x[1][2 * r] = q == 0 ? positions[r].x : q == 1 ? positions[r].z : 0.0f;
    x[1][2 * r + 1] = q == 0 ? positions[r].y : q == 1 ? 1.0f : 0.0f;
  }
  std::uint32_t active[2];
  float sdf[2], slope[2], g[2][4];
  network.forward(x, lane, active, sdf);
#pragma unroll
  for (int r = 0; r < 2; ++r) slope[r] = activation_slope(MlpActivation::kTanh, sdf[r]);
  network.backward(active, slope, lane, g);
  const float inverse_voxel = 1.0f / scene.voxel_size;
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    Vec3<float> sum = inverse_voxel * (g[0][2 * r] * slopes[r][0] + g[0][2 * r + 1] * slopes[r][1]);
    if (q == 0) sum = sum + scene.position_scale * Vec3<float>{g[1][2 * r], g[1][2 * r + 1], 0.0f};
    if (q == 1) sum.z += scene.position_scale * g[1][2 * r];
    sum = {fused::sum_quad(sum.x), fused::sum_quad(sum.y), fused::sum_quad(sum.z)};
    if (r == own) gradient = sum;
  }
  return own ? sdf[1] : sdf[0];
}

}  // namespace spslam
