// Rendering weights and losses of the rays of a chunk, and their gradients to SDF and color (equations 5-11).
#pragma once

#include "cpu/render_step_chunk.h"

namespace spslam::render {

// Normalized weights of a ray's samples and its depth; lists the samples that are rendered.
inline void weigh_ray(float truncation, Ray& ray, Chunk& chunk) {
  float first_crossing = std::numeric_limits<float>::infinity();
  for (std::int32_t i = ray.begin; i < ray.end; ++i) {
    const float crossing = crossing_depth(chunk.sdf[i], chunk.t[i], true);
    first_crossing = crossing < first_crossing ? crossing : first_crossing;
  }
  float sum = 0.0f;
  for (std::int32_t i = ray.begin; i < ray.end; ++i) {
    const bool visible = sample_visible(chunk.t[i], true, first_crossing, truncation);
    chunk.bells[i] = visible ? chunk.bells[i] : 0.0f;
    chunk.bell_slopes[i] = visible ? chunk.bell_slopes[i] : 0.0f;
    sum += chunk.bells[i];
  }
  ray.inverse_bell_sum = inverse_weight_sum(sum);
  ray.rendered_depth = 0.0f;
  ray.color_begin = static_cast<std::int32_t>(chunk.num_colors);
  for (std::int32_t i = ray.begin; i < ray.end; ++i) {
    chunk.weights[i] = chunk.bells[i] * ray.inverse_bell_sum;
    ray.rendered_depth += chunk.weights[i] * chunk.t[i];
    chunk.color_sample[chunk.num_colors] = i;
    chunk.num_colors += chunk.weights[i] != 0.0f;
  }
  ray.color_end = static_cast<std::int32_t>(chunk.num_colors);
}

inline void weigh_samples(float truncation, Chunk& chunk) {
  chunk.num_colors = 0;
  for (std::int64_t i = 0; i < chunk.num_rays; ++i) weigh_ray(truncation, chunk.rays[i], chunk);
}

// Color of a ray, its loss, and the gradient to the colors of its samples.
inline void render_color(float scale, Ray& ray, Chunk& chunk) {
  const std::int64_t stride = chunk.rgb_stride;
  for (int c = 0; c < 3; ++c) {
    float sum = 0.0f;
    for (std::int32_t j = ray.color_begin; j < ray.color_end; ++j) {
      sum += chunk.weights[chunk.color_sample[j]] * chunk.rgb[c * stride + j];
    }
    ray.rendered_color[c] = sum;
    const float grad = scale * color_loss_gradient(sum, ray.pixel.color[c]);
    for (std::int32_t j = ray.color_begin; j < ray.color_end; ++j) {
      chunk.grad_rgb[c * stride + j] = grad * chunk.weights[chunk.color_sample[j]];
    }
  }
  ray.losses.rgb = color_loss(ray.rendered_color, ray.pixel.color);
}

// The terms on the SDF itself, and their gradient.
inline void supervise_samples(const LossWeights& scale, float truncation, Ray& ray, Chunk& chunk) {
  const SdfSupervision<float> supervision{ray.pixel.depth,
                                          ray.cosine,
                                          truncation,
                                          inverse_count<float>(ray.num_near),
                                          inverse_count<float>(ray.num_free),
                                          scale.sdf,
                                          scale.free_space};
  for (std::int32_t i = ray.begin; i < ray.end; ++i) {
    chunk.grad_sdf[i] = supervise_sample(supervision, chunk.sdf[i], chunk.t[i], ray.losses);
  }
}

// Adds the gradient of the rendered color and depth through the weights.
inline void add_rendering_gradient(const LossWeights& scale, bool color, const Ray& ray, Chunk& chunk) {
  const std::int64_t stride = chunk.rgb_stride;
  const float grad_depth = scale.depth * depth_loss_gradient(ray.rendered_depth, ray.pixel.depth);
  float grad_color[3] = {0.0f, 0.0f, 0.0f};
  float mean = grad_depth * ray.rendered_depth;
  for (int c = 0; color && c < 3; ++c) {
    grad_color[c] = scale.rgb * color_loss_gradient(ray.rendered_color[c], ray.pixel.color[c]);
    mean += grad_color[c] * ray.rendered_color[c];
  }
  for (std::int32_t j = ray.color_begin; j < ray.color_end; ++j) {
    const std::int32_t i = chunk.color_sample[j];
    float grad_weight = grad_depth * chunk.t[i];
    for (int c = 0; color && c < 3; ++c) grad_weight += grad_color[c] * chunk.rgb[c * stride + j];
    chunk.grad_sdf[i] += weight_backward(grad_weight, mean, chunk.bell_slopes[i], ray.inverse_bell_sum);
  }
}

// Losses of every ray, and their gradients to the SDF and the color of its samples. `scale` is the weights of the
// terms over the number of rays.
inline void ray_losses(const LossWeights& scale, bool color, float truncation, Chunk& chunk) {
  for (std::int64_t r = 0; r < chunk.num_rays; ++r) {
    Ray& ray = chunk.rays[r];
    ray.losses = {};
    if (!ray.valid) continue;
    supervise_samples(scale, truncation, ray, chunk);
    if (ray.inverse_bell_sum == 0.0f) continue;
    ray.losses.depth = depth_loss(ray.rendered_depth, ray.pixel.depth);
    if (color) render_color(scale.rgb, ray, chunk);
    add_rendering_gradient(scale, color, ray, chunk);
  }
}

}  // namespace spslam::render
