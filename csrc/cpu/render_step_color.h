// Color in render_step on the CPU: texels of three planes gathered and decoded, and the gradients of texels and
// positions.
#pragma once

#include <initializer_list>

#include "cpu/render_step_geometry.h"
#include "kernels/interpolation.h"

namespace spslam::render {

// One plane of the table.
struct PlaneTexels {
  const float* texels;          // of the table's first row
  std::int64_t step_u, step_v;  // rows to the next texel; 0 where the plane has but one
  PlaneLayout layout;

  PlaneTexels(const float* table, const PlaneLayout& plane)
      : texels(table), step_u(plane.size_u > 1 ? plane.size_v : 0), step_v(plane.size_v > 1 ? 1 : 0), layout(plane) {}
};

inline bool planes_cover(const TriPlaneLayout& layout) {
  return !empty_plane(layout.planes[0]) && !empty_plane(layout.planes[1]) && !empty_plane(layout.planes[2]);
}

// A sample's cells in the three planes: lower rows and fractions; slopes are d fraction / d point (1/m), 0 where
// clamped.
struct PlaneSample {
  std::int64_t rows[3];
  PlaneFraction fractions[3];
  float slope_u[3], slope_v[3];
};

inline PlaneSample locate_in_planes(const PlaneTexels (&planes)[3], float inverse_cell, const Vec3<float>& point) {
  PlaneSample sample;
  for (int p = 0; p < 3; ++p) {
    const PlaneLayout& layout = planes[p].layout;
    const AxisCell<float> u = axis_cell(plane_u(point, p) * inverse_cell, layout.origin_u, layout.size_u);
    const AxisCell<float> v = axis_cell(plane_v(point, p) * inverse_cell, layout.origin_v, layout.size_v);
    sample.rows[p] = layout.offset + std::int64_t{u.lower} * layout.size_v + v.lower;
    sample.fractions[p] = {u.fraction, v.fraction};
    sample.slope_u[p] = u.slope * inverse_cell;
    sample.slope_v[p] = v.slope * inverse_cell;
  }
  return sample;
}

// x = sum of the planes (equation 3); slopes[3, channels] = its derivatives by the point, where wanted.
inline void interpolate_texels(const PlaneTexels (&planes)[3], const PlaneSample& sample, float* x, float* slopes) {
  using V = Vector<float>;
  for (std::int64_t c = 0; c < kPlaneChannels; c += kLanes<float>) {
    V value{}, by_u[3], by_v[3];
    for (int p = 0; p < 3; ++p) {
      const PlaneFraction& f = sample.fractions[p];
      const float* texel = planes[p].texels + sample.rows[p] * kPlaneChannels + c;
      const std::int64_t step_u = planes[p].step_u * kPlaneChannels, step_v = planes[p].step_v * kPlaneChannels;
      const V t00 = load_vector<V>(texel), t10 = load_vector<V>(texel + step_u);
      const V t01 = load_vector<V>(texel + step_v), t11 = load_vector<V>(texel + step_u + step_v);
      const V low = t00 + f.v * (t01 - t00), high = t10 + f.v * (t11 - t10);
      value += low + f.u * (high - low);
      by_u[p] = sample.slope_u[p] * (high - low);
      by_v[p] = sample.slope_v[p] * ((t01 - t00) + f.u * ((t11 - t10) - (t01 - t00)));
    }
    store_vector(x + c, value);
    if (!slopes) continue;
    // The planes are xy, xz, yz.
    store_vector(slopes + c, by_u[0] + by_u[1]);
    store_vector(slopes + kPlaneChannels + c, by_v[0] + by_u[2]);
    store_vector(slopes + 2 * kPlaneChannels + c, by_v[1] + by_v[2]);
  }
}

// Prefetches the cells that differ from those of the sample before.
inline void prefetch_texels(const PlaneTexels (&planes)[3], const PlaneSample& sample, const PlaneSample& before) {
  for (int p = 0; p < 3; ++p) {
    if (sample.rows[p] == before.rows[p]) continue;
    const float* texel = planes[p].texels + sample.rows[p] * kPlaneChannels;
    for (const float* corner : {texel, texel + planes[p].step_u * kPlaneChannels}) {
      for (std::int64_t c = 0; c < 2 * kPlaneChannels; c += 16) __builtin_prefetch(corner + c);
    }
  }
}

// Writes the runs of rendered samples that lie in the same cell.
class TexelRunWriter {
 public:
  TexelRunWriter(std::int64_t first_row, const TableGradients& tables) : tables_(tables), first_row_(first_row) {}

  void add(std::int64_t j, const PlaneSample& sample) {
    for (int p = 0; p < 3; ++p) {
      const std::int64_t at = p * tables_.rows + first_row_;
      TexelRun* runs = tables_.texel_runs + at;
      tables_.fractions[at + j] = sample.fractions[p];
      if (counts_[p] == 0 || runs[counts_[p] - 1].row != sample.rows[p]) {
        runs[counts_[p]++].row = static_cast<std::int32_t>(sample.rows[p]);
      }
      runs[counts_[p] - 1].end = static_cast<std::int32_t>(j + 1);
    }
  }

  void finish(std::int64_t chunk) const {
    for (int p = 0; p < 3; ++p) tables_.num_texel_runs[3 * chunk + p] = counts_[p];
  }

 private:
  const TableGradients& tables_;
  const std::int64_t first_row_;
  std::int64_t counts_[3] = {0, 0, 0};
};

// Fills the color decoder's input for the rendered samples.
inline void gather_texels(const SceneView& scene, const MlpLayout<float>& layout, const Plan& plan, std::int64_t index,
                          const TableGradients& tables, Chunk& chunk) {
  constexpr std::int64_t kAhead = 16;
  const PlaneLayout* p = scene.planes.planes;
  const PlaneTexels planes[3] = {{scene.texels, p[0]}, {scene.texels, p[1]}, {scene.texels, p[2]}};
  const float inverse_cell = 1.0f / scene.plane_cell_size;
  TexelRunWriter runs(index * tables.capacity, tables);
  PlaneSample queue[kAhead];
  for (PlaneSample& sample : queue) sample.rows[0] = sample.rows[1] = sample.rows[2] = -1;
  const auto locate = [&](std::int64_t j) {
    const std::int32_t i = chunk.color_sample[j];
    queue[j % kAhead] = locate_in_planes(planes, inverse_cell, sample_point(chunk.rays[chunk.ray_of[i]], chunk.t[i]));
    prefetch_texels(planes, queue[j % kAhead], queue[(j + kAhead - 1) % kAhead]);
  };
  const std::int64_t n = planes_cover(scene.planes) ? chunk.num_colors : 0;
  for (std::int64_t j = 0; j < n && j < kAhead; ++j) locate(j);
  for (std::int64_t j = 0; j < n; ++j) {
    const PlaneSample sample = queue[j % kAhead];
    if (j + kAhead < n) locate(j + kAhead);
    interpolate_texels(planes, sample, chunk.color_x + j * layout.input_stride,
                       plan.pose ? chunk.color_slopes + j * kColorSlopes : nullptr);
    if (plan.texels) runs.add(j, sample);
  }
  if (plan.texels) runs.finish(index);
  const std::int64_t padded = round_up(chunk.num_colors, kRowBlock) * layout.input_stride;
  for (std::int64_t k = n * layout.input_stride; k < padded; ++k) chunk.color_x[k] = 0.0f;
  for (std::int64_t k = n * kColorSlopes; k < chunk.num_colors * kColorSlopes; ++k) chunk.color_slopes[k] = 0.0f;
}

inline void decode_color(const PackedMlp<float>& net, Chunk& chunk) {
  const MlpLayout<float>& l = net.layout;
  for (std::int64_t row = 0; row < chunk.num_colors; row += kTileRows) {
    const std::int64_t rows = row + kTileRows < chunk.num_colors ? kTileRows : chunk.num_colors - row;
    mlp_tile_forward(net, round_up(rows, kRowBlock), chunk.color_x + row * l.input_stride,
                     chunk.color_h1 + row * l.hidden_stride, chunk.color_h2 + row * l.hidden_stride, chunk.rgb + row,
                     chunk.rgb_stride);
  }
  for (int c = 0; c < 3; ++c) {
    float* rgb = chunk.rgb + c * chunk.rgb_stride;
#pragma omp simd
    for (std::int64_t j = 0; j < chunk.num_colors; ++j) rgb[j] = sigmoid(rgb[j]);
  }
}

// Adds to the samples the gradients that come by their colors.
inline void add_color_gradients(const float* grad_x, std::int64_t first, std::int64_t rows, Chunk& chunk) {
  for (std::int64_t r = 0; r < rows; ++r) {
    const float* slopes = chunk.color_slopes + (first + r) * kColorSlopes;
    Vector<float> sums[3] = {};
    for (std::int64_t c = 0; c < kPlaneChannels; c += kLanes<float>) {
      const Vector<float> grad = load_vector<Vector<float>>(grad_x + r * kPlaneChannels + c);
      for (int k = 0; k < 3; ++k) sums[k] += grad * load_vector<Vector<float>>(slopes + k * kPlaneChannels + c);
    }
    add_sample_gradient(chunk, chunk.color_sample[first + r],
                        {sum_lanes<float>(sums[0]), sum_lanes<float>(sums[1]), sum_lanes<float>(sums[2])});
  }
}

// Backward pass from grad_rgb to parameters (added to `partial`, where given), texels (rows written to `tables`, where
// given) and rays.
inline void color_backward(const PackedMlp<float>& net, const Plan& plan, std::int64_t first_row,
                           const TableGradients& tables, float* partial, Chunk& chunk) {
  const MlpLayout<float>& l = net.layout;
  const std::int64_t n = chunk.num_colors, stride = chunk.rgb_stride;
  for (int c = 0; c < 3; ++c) {
    float *grad = chunk.grad_rgb + c * stride, *rgb = chunk.rgb + c * stride;
#pragma omp simd
    for (std::int64_t j = 0; j < n; ++j) grad[j] *= activation_slope(MlpActivation::kSigmoid, rgb[j]);
    for (std::int64_t j = n; j < round_up(n, kRowBlock); ++j) grad[j] = 0.0f;
  }
  const DecoderRows decoder{n, chunk.color_x, chunk.color_h1, chunk.color_h2, chunk.grad_rgb, stride};
  float* table = plan.texels ? tables.texel + first_row * l.input_stride : nullptr;
  decoder_backward(net, decoder, plan.color_params ? partial : nullptr, table, plan.pose, chunk,
                   [&](const float* grad_x, std::int64_t first, std::int64_t rows) {
                     add_color_gradients(grad_x, first, rows, chunk);
                   });
}

}  // namespace spslam::render
