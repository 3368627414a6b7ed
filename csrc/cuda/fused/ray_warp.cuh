// Forward pass, losses and backward pass of one ray by one warp.
#pragma once

#include <type_traits>

#include "cuda/fused/color_tile.cuh"
#include "cuda/fused/geometry_tile.cuh"
#include "cuda/fused/ray_losses.cuh"
#include "cuda/fused/table_scatter.cuh"
#include "kernels/ray_pose_gradient.h"

namespace spslam::fused {

// A warp's shared memory; GradientRows only where the scene is optimized.
struct WarpMemory {
  RayScratch scratch;
  PlanePlaces places;
};
struct TrainingMemory : WarpMemory {
  GradientRows rows;
};

// kTrain: gradients of the scene, where the arguments ask for them; if not, of the pose alone.
template <Precision kPrecision, bool kTrain>
class RayWarp {
 public:
  using Memory = typename std::conditional<kTrain, TrainingMemory, WarpMemory>::type;

  __device__ __forceinline__ RayWarp(const RayStepArguments& arguments, const float* image, Memory& memory,
                                     Stage<kPrecision>* stage, int lane)
      : a(arguments), image_(image), memory_(memory), stage_(stage), lane_(lane) {}

  // Samples, decodes and weighs ray r; adds its losses.
  __device__ __forceinline__ void forward(std::int64_t r, RayLosses<float>& losses) {
    RayScratch& scratch = memory_.scratch;
    geometry_left_ = color_left_ = 0;
    ray_ = load_ray(a, r);
    pose_gradient_ = {};
    if (!ray_.valid) return;
    place_samples(a, r, ray_.pixel.depth, lane_, scratch);
    find_samples_inside(a, lane_, ray_, scratch);
    if (ray_.inside == 0) return;
    geometry_left_ = tiles(ray_.inside);
    for (int tile = 0; tile < geometry_left_; ++tile) decode_geometry(tile);
    const RayRendering rendering = weigh_samples(ray_, a.sampling.truncation, lane_, scratch);
    rendered_ = a.color ? rendering.num_rendered : 0;
    color_left_ = tiles(rendered_);
    for (int tile = 0; tile < color_left_; ++tile) decode_color(tile);
    supervise_ray(a, ray_, rendering, lane_, scratch, losses, grad_color_);
    geometry_last_ = geometry_left_, color_last_ = color_left_;
    if (!a.pose && !a.embeddings.sums && !a.geometry_params) geometry_left_ = 0;
    if (!a.pose && !a.texels.sums && !a.color_params) color_left_ = 0;
  }

  // For a warp without a ray.
  __device__ __forceinline__ void skip() { geometry_left_ = color_left_ = 0; }

  __device__ __forceinline__ bool pending() const { return geometry_left_ > 0 || color_left_ > 0; }

  // Backward pass of one tile of each decoder, the last first; returns which were staged.
  __device__ __forceinline__ int backward() {
    int staged = 0;
    if (geometry_left_ > 0) {
      geometry_back(--geometry_left_);
      if (kTrain && a.geometry_params) staged |= kStagedGeometry;
    }
    if (color_left_ > 0) {
      color_back(--color_left_);
      if (kTrain && a.color_params) staged |= kStagedColor;
    }
    return staged;
  }

  // d L / d pose, in all lanes.
  __device__ __forceinline__ PoseGradient pose_gradient() const {
    return spslam::pose_gradient({sum_warp(pose_gradient_.translation), sum_warp(pose_gradient_.moment)},
                                 ray_.direction);
  }

 private:
  static __device__ __forceinline__ int tiles(int samples) { return (samples + kTileRows - 1) / kTileRows; }

  // Nothing is staged for a frozen scene, known at compile time.
  __device__ __forceinline__ Stage<kPrecision>* stage() const { return kTrain ? stage_ : nullptr; }

  __device__ __forceinline__ void decode_geometry(int tile) {
    RayScratch& scratch = memory_.scratch;
    const int base = kTileRows * tile;
    geometry_forward<kPrecision>(a, image_, scratch, base, ray_.inside, lane_, geometry_, stage());
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const int i = base + lane_row(lane_) + 8 * r;
      if (lane_quad(lane_) == 0 && i < ray_.inside) scratch.sdf[i] = geometry_.sdf[r];
    }
    __syncwarp();
  }

  __device__ __forceinline__ void decode_color(int tile) {
    RayScratch& scratch = memory_.scratch;
    const int base = kTileRows * tile;
    if (a.planes_cover) locate_in_planes(a, scratch, base, rendered_, lane_, memory_.places);
    color_forward<kPrecision>(a, image_, memory_.places, lane_, color_, stage());
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const int k = base + lane_row(lane_) + 8 * r;
      if (lane_quad(lane_) != 0 || k >= rendered_) continue;
      scratch.rgb[scratch.rendered[k]] = make_float4(color_.rgb[r][0], color_.rgb[r][1], color_.rgb[r][2], 0.0f);
    }
    __syncwarp();
  }

  // The last tile is still in the registers; the others are decoded again.
  __device__ __forceinline__ void geometry_back(int tile) {
    RayScratch& scratch = memory_.scratch;
    const int base = kTileRows * tile;
    if (tile != geometry_last_ - 1) {
      geometry_forward<kPrecision>(a, image_, scratch, base, ray_.inside, lane_, geometry_, stage());
    }
    float grad_sdf[2], grad_x[2][4];
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const int i = base + lane_row(lane_) + 8 * r;
      grad_sdf[r] = i < ray_.inside ? scratch.grad_sdf[i] : 0.0f;
    }
    geometry_backward<kPrecision>(image_, geometry_, grad_sdf, lane_, grad_x, stage());
    if (a.pose) {
#pragma unroll
      for (int r = 0; r < 2; ++r) {
        const int i = min(base + lane_row(lane_) + 8 * r, ray_.inside - 1);
        add_point_gradient(geometry_point_gradient(a, geometry_, grad_x, r, lane_), scratch.place[i].w, pose_gradient_);
      }
    }
    if constexpr (kTrain) {
      if (a.embeddings.sums) scatter_embeddings(a, scratch, base, ray_.inside, grad_x, lane_, memory_.rows);
    }
  }

  __device__ __forceinline__ void color_back(int tile) {
    RayScratch& scratch = memory_.scratch;
    const int base = kTileRows * tile;
    if (tile != color_last_ - 1) {
      if (a.planes_cover) locate_in_planes(a, scratch, base, rendered_, lane_, memory_.places);
      color_forward<kPrecision>(a, image_, memory_.places, lane_, color_, stage());
    }
    float grad_rgb[2][3], grad_x[4][4];
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const int k = base + lane_row(lane_) + 8 * r;
      const float weight = k < rendered_ ? scratch.weight[scratch.rendered[k]] : 0.0f;
#pragma unroll
      for (int c = 0; c < 3; ++c) grad_rgb[r][c] = weight * grad_color_[c];
    }
    color_backward<kPrecision>(image_, color_, grad_rgb, lane_, grad_x, stage());
    if (!a.planes_cover) return;
    if (a.pose) {
#pragma unroll
      for (int r = 0; r < 2; ++r) {
        const int k = min(base + lane_row(lane_) + 8 * r, rendered_ - 1);
        add_point_gradient(color_point_gradient(a, memory_.places, grad_x, r, lane_),
                           scratch.place[scratch.rendered[k]].w, pose_gradient_);
      }
    }
    if constexpr (kTrain) {
      if (a.texels.sums) scatter_texels(a, memory_.places, base, rendered_, grad_x, lane_, memory_.rows);
    }
  }

  const RayStepArguments& a;
  const float* const image_;
  Memory& memory_;
  Stage<kPrecision>* const stage_;
  const int lane_;
  WarpRay ray_;
  int rendered_, geometry_left_, color_left_, geometry_last_, color_last_;
  GeometryTile geometry_;
  ColorTile color_;
  float grad_color_[3];
  RayPoseGradient pose_gradient_;
};

}  // namespace spslam::fused
