// One warp's ray: its samples in order of depth, and those that lie in complete cells.
#pragma once

#include "cuda/fused/arguments.cuh"
#include "cuda/fused/fragment.cuh"
#include "kernels/interpolation.h"
#include "kernels/ray_sampling.h"
#include "kernels/ray_source.h"
#include "kernels/volume_rendering.h"
#include "kernels/voxel_hash.h"

namespace spslam::fused {

// A warp's shared memory. Arrays but `t` are indexed by sample inside, in order of depth.
struct RayScratch {
  float4 place[kMaxSamples];     // world point, depth (m)
  int4 corners[kMaxSamples][2];  // voxel ids
  float4 rgb[kMaxSamples];       // of rendered samples
  float t[kMaxSamples];          // of all samples
  float sdf[kMaxSamples], grad_sdf[kMaxSamples], weight[kMaxSamples];
  int rendered[kMaxSamples];  // the samples of non-zero weight
};

// Equal in all lanes.
struct WarpRay {
  Vec3<float> origin, direction;
  Pixel pixel;
  float cosine;
  bool valid;  // has a depth and a pose
  int inside, num_free, num_near;
};

__device__ __forceinline__ WarpRay load_ray(const RayStepArguments& a, std::int64_t r) {
  WarpRay ray{};
  const std::int64_t slot = ray_slot(a.rays, r);
  if (slot < 0 || slot >= a.rays.num_slots) return ray;
  const std::int64_t row = slot_row(a.rays, slot);
  ray.pixel = unpack_pixel(ray_record(a.rays, r, row));
  ray.valid = has_depth(ray.pixel.depth);
  ray.cosine = a.cosine_targets ? ray.pixel.foreshortening : 1.0f;
  const Pose<float> pose = load_pose(a.rays.poses + 7 * row);
  ray.origin = pose.translation;
  ray.direction = pose.rotation * pixel_ray(ray.pixel, a.camera);
  return ray;
}

// Draws the samples, lane l those of number l and l + 32, and writes their depths to scratch.t in ascending order; of
// equal depths the uniform one comes first.
__device__ __forceinline__ void place_samples(const RayStepArguments& a, std::int64_t r, float depth, int lane,
                                              RayScratch& scratch) {
  const int uniform = a.sampling.num_uniform, samples = a.sampling.num_samples();
  const int s0 = lane, s1 = lane + kWarp;
  const float t0 = s0 < samples ? sample_depth(a.sampling, depth, s0, sample_uniform(a.key, a.sampling, r, s0)) : 0.0f;
  const float t1 = s1 < samples ? sample_depth(a.sampling, depth, s1, sample_uniform(a.key, a.sampling, r, s1)) : 0.0f;
  int rank0 = s0, rank1 = s1;
  for (int s = uniform; s < samples; ++s) {
    const float t = __shfl_sync(kAllLanes, s < kWarp ? t0 : t1, s % kWarp);
    const unsigned before0 = __ballot_sync(kAllLanes, s0 < uniform && t0 <= t);
    const unsigned before1 = __ballot_sync(kAllLanes, s1 < uniform && t1 <= t);
    const int rank = s - uniform + __popc(before0) + __popc(before1);
    rank0 = s0 == s ? rank : rank0 + (s0 < uniform && t < t0);
    rank1 = s1 == s ? rank : rank1 + (s1 < uniform && t < t1);
  }
  if (s0 < samples) scratch.t[rank0] = t0;
  if (s1 < samples) scratch.t[rank1] = t1;
  __syncwarp();
}

// One sample before it is listed among those inside.
struct LocatedSample {
  Vec3<float> point;
  float t;
  int4 low, high;  // corners
  bool inside, free, near;
};

__device__ __forceinline__ LocatedSample locate_sample(const RayStepArguments& a, const WarpRay& ray, float t,
                                                       bool exists) {
  LocatedSample sample{};
  if (!exists) return sample;
  sample.t = t;
  sample.point = ray.origin + t * ray.direction;
  const Cell<float> cell =
      find_cell(a.scene.table, a.scene.corner_ids, a.scene.num_voxels, a.inverse_voxel * sample.point);
  if (cell.corner_ids) {
    sample.low = reinterpret_cast<const int4*>(cell.corner_ids)[0];
    sample.high = reinterpret_cast<const int4*>(cell.corner_ids)[1];
    const std::int32_t ids[kCellCorners] = {sample.low.x,  sample.low.y,  sample.low.z,  sample.low.w,
                                            sample.high.x, sample.high.y, sample.high.z, sample.high.w};
    sample.inside = complete_cell(ids, a.scene.num_voxels);
  }
  const SampleTarget<float> target =
      sample_target(ray.pixel.depth, t, ray.cosine, a.sampling.truncation, sample.inside);
  sample.free = target.free;
  sample.near = target.near;
  return sample;
}

__device__ __forceinline__ void keep_sample(const LocatedSample& sample, int at, RayScratch& scratch) {
  if (!sample.inside) return;
  scratch.place[at] = make_float4(sample.point.x, sample.point.y, sample.point.z, sample.t);
  scratch.corners[at][0] = sample.low;
  scratch.corners[at][1] = sample.high;
}

// Looks up the cells of all samples, keeps those inside in order of depth, and counts the targets of each kind.
__device__ __forceinline__ void find_samples_inside(const RayStepArguments& a, int lane, WarpRay& ray,
                                                    RayScratch& scratch) {
  const int samples = a.sampling.num_samples();
  const bool exists0 = lane < samples, exists1 = lane + kWarp < samples;
  const LocatedSample first = locate_sample(a, ray, exists0 ? scratch.t[lane] : 0.0f, exists0);
  const LocatedSample second = locate_sample(a, ray, exists1 ? scratch.t[lane + kWarp] : 0.0f, exists1);
  const unsigned inside0 = __ballot_sync(kAllLanes, first.inside), inside1 = __ballot_sync(kAllLanes, second.inside);
  const unsigned below = (1u << lane) - 1u;
  keep_sample(first, __popc(inside0 & below), scratch);
  keep_sample(second, __popc(inside0) + __popc(inside1 & below), scratch);
  ray.inside = __popc(inside0) + __popc(inside1);
  ray.num_free = __popc(__ballot_sync(kAllLanes, first.free)) + __popc(__ballot_sync(kAllLanes, second.free));
  ray.num_near = __popc(__ballot_sync(kAllLanes, first.near)) + __popc(__ballot_sync(kAllLanes, second.near));
  __syncwarp();
}

}  // namespace spslam::fused
