// Rendering weights and losses of a ray, lane l on samples l and l + 32 of those inside (equations 5-11).
#pragma once

#include "cuda/fused/warp_ray.cuh"

namespace spslam::fused {

// A warp's rendered ray; equal in all lanes but for the bells.
struct RayRendering {
  float bell_slope[2];  // of the lane's samples
  float inverse_sum;    // 0 where nothing is rendered
  float depth;
  int num_rendered;
};

// Normalized weights to scratch.weight, and the list of the samples that are rendered.
__device__ __forceinline__ RayRendering weigh_samples(const WarpRay& ray, float truncation, int lane,
                                                      RayScratch& scratch) {
  RayRendering out{};
  float t[2], crossing[2], value[2];
  const float inverse_truncation = 1.0f / truncation;
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const int i = lane + kWarp * k;
    const bool exists = i < ray.inside;
    const float sdf = exists ? scratch.sdf[i] : 1.0f;
    t[k] = exists ? scratch.place[i].w : 0.0f;
    const Bell<float> b = bell(sdf, inverse_truncation);
    value[k] = exists ? b.value : 0.0f;
    out.bell_slope[k] = exists ? b.slope : 0.0f;
    crossing[k] = crossing_depth(sdf, t[k], exists);
  }
  const float first = min_warp(fminf(crossing[0], crossing[1]));
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const bool visible = sample_visible(t[k], true, first, truncation);
    value[k] = visible ? value[k] : 0.0f;
    out.bell_slope[k] = visible ? out.bell_slope[k] : 0.0f;
  }
  out.inverse_sum = inverse_weight_sum(sum_warp(value[0] + value[1]));
  unsigned rendered[2];
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const int i = lane + kWarp * k;
    value[k] *= out.inverse_sum;
    if (i < ray.inside) scratch.weight[i] = value[k];
    rendered[k] = __ballot_sync(kAllLanes, i < ray.inside && value[k] != 0.0f);
    const int before = (k ? __popc(rendered[0]) : 0) + __popc(rendered[k] & ((1u << lane) - 1u));
    if (rendered[k] >> lane & 1) scratch.rendered[before] = i;
  }
  out.depth = sum_warp(value[0] * t[0] + value[1] * t[1]);
  out.num_rendered = __popc(rendered[0]) + __popc(rendered[1]);
  __syncwarp();
  return out;
}

// Losses of a ray, added to `losses`, whose sum over the lanes counts; gradients by the SDF to scratch.grad_sdf, and by
// the rendered color to grad_color.
__device__ __forceinline__ void supervise_ray(const RayStepArguments& a, const WarpRay& ray,
                                              const RayRendering& rendering, int lane, RayScratch& scratch,
                                              RayLosses<float>& losses, float (&grad_color)[3]) {
  const bool rendered = rendering.inverse_sum != 0.0f;
  float4 rgb[2];
  float weight[2], color[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const int i = lane + kWarp * k;
    weight[k] = i < ray.inside ? scratch.weight[i] : 0.0f;
    rgb[k] = a.color && weight[k] != 0.0f ? scratch.rgb[i] : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    color[0] += weight[k] * rgb[k].x;
    color[1] += weight[k] * rgb[k].y;
    color[2] += weight[k] * rgb[k].z;
  }
#pragma unroll
  for (int c = 0; c < 3; ++c) {
    if (a.color) color[c] = sum_warp(color[c]);
    grad_color[c] = a.color && rendered ? a.scale.rgb * color_loss_gradient(color[c], ray.pixel.color[c]) : 0.0f;
  }
  const float grad_depth = rendered ? a.scale.depth * depth_loss_gradient(rendering.depth, ray.pixel.depth) : 0.0f;
  const float mean =
      grad_depth * rendering.depth + grad_color[0] * color[0] + grad_color[1] * color[1] + grad_color[2] * color[2];
  if (lane == 0 && rendered) {
    losses.depth += depth_loss(rendering.depth, ray.pixel.depth);
    if (a.color) losses.rgb += color_loss(color, ray.pixel.color);
  }
  const SdfSupervision<float> supervision{ray.pixel.depth,
                                          ray.cosine,
                                          a.sampling.truncation,
                                          inverse_count<float>(ray.num_near),
                                          inverse_count<float>(ray.num_free),
                                          a.scale.sdf,
                                          a.scale.free_space};
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const int i = lane + kWarp * k;
    if (i >= ray.inside) continue;
    const float t = scratch.place[i].w;
    const float grad_weight =
        grad_depth * t + grad_color[0] * rgb[k].x + grad_color[1] * rgb[k].y + grad_color[2] * rgb[k].z;
    scratch.grad_sdf[i] = supervise_sample(supervision, scratch.sdf[i], t, losses) +
                          weight_backward(grad_weight, mean, rendering.bell_slope[k], rendering.inverse_sum);
  }
  __syncwarp();
}

}  // namespace spslam::fused
