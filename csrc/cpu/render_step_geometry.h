// Geometry in render_step on the CPU: embeddings gathered and decoded, and the gradients of embeddings and positions.
#pragma once

#include "cpu/render_step_decoder.h"
#include "kernels/decoders.h"
#include "kernels/interpolation.h"

namespace spslam::render {

struct FeatureSlopes {
  Feature value, x, y, z;  // and its derivatives by the position in the cell
};

inline FeatureSlopes interpolate_embedding(const float* embeddings, const std::int32_t* corners,
                                           const Vec3<float>& local) {
  Feature e[kCellCorners];
  for (int k = 0; k < kCellCorners; ++k) {
    e[k] = load_vector<Feature>(embeddings + kEmbeddingChannels * std::int64_t{corners[k]});
  }
  const auto mix = [](const Feature& a, const Feature& b, float s) { return a + s * (b - a); };
  Feature edge[4], along[4];  // on the four edges along x
  for (int k = 0; k < 4; ++k) {
    along[k] = e[2 * k + 1] - e[2 * k];
    edge[k] = e[2 * k] + local.x * along[k];
  }
  const Feature low = mix(edge[0], edge[1], local.y), high = mix(edge[2], edge[3], local.y);
  return {mix(low, high, local.z), mix(mix(along[0], along[1], local.y), mix(along[2], along[3], local.y), local.z),
          mix(edge[1] - edge[0], edge[3] - edge[2], local.z), high - low};
}

inline Vec3<float> sample_point(const Ray& ray, float t) {
  return ray.origin + t * ray.direction;
}

// Fills the decoder's input for the samples inside.
inline void gather_embeddings(const SceneView& scene, const MlpLayout<float>& layout, bool need_slopes, Chunk& chunk) {
  const float inverse_voxel = 1.0f / scene.voxel_size;
  const Vec3<float> origin{scene.origin[0], scene.origin[1], scene.origin[2]};
  for (std::int64_t i = 0; i < chunk.num_inside; ++i) {
    const Vec3<float> point = sample_point(chunk.rays[chunk.ray_of[i]], chunk.t[i]);
    const Vec3<float> local = voxel_cell(point, inverse_voxel).local;
    const std::int32_t* corners = scene.corner_ids + kCellCorners * std::int64_t{chunk.voxel_of[i]};
    const FeatureSlopes feature = interpolate_embedding(scene.embeddings, corners, local);
    const Vec3<float> position = scene.position_scale * (point - origin);
    float* x = chunk.x + i * layout.input_stride;
    for (std::int64_t c = layout.input; c < layout.input_stride; ++c) x[c] = 0.0f;
    x[0] = position.x;
    x[1] = position.y;
    x[2] = position.z;
    store_vector(x + 3, feature.value);
    chunk.local[i] = local;
    if (!need_slopes) continue;
    float* slopes = chunk.slopes + i * kGeometrySlopes;
    store_vector(slopes, feature.x);
    store_vector(slopes + kEmbeddingChannels, feature.y);
    store_vector(slopes + 2 * kEmbeddingChannels, feature.z);
  }
  const std::int64_t padded = round_up(chunk.num_inside, kRowBlock) * layout.input_stride;
  for (std::int64_t i = chunk.num_inside * layout.input_stride; i < padded; ++i) chunk.x[i] = 0.0f;
}

// SDF and bell of the samples inside.
inline void decode_geometry(const PackedMlp<float>& net, float inverse_truncation, Chunk& chunk) {
  const MlpLayout<float>& l = net.layout;
  for (std::int64_t row = 0; row < chunk.num_inside; row += kTileRows) {
    const std::int64_t rows = row + kTileRows < chunk.num_inside ? kTileRows : chunk.num_inside - row;
    mlp_tile_forward(net, round_up(rows, kRowBlock), chunk.x + row * l.input_stride, chunk.h1 + row * l.hidden_stride,
                     chunk.h2 + row * l.hidden_stride, chunk.sdf + row, rows);
  }
#pragma omp simd
  for (std::int64_t i = 0; i < chunk.num_inside; ++i) {
    const float sdf = hyperbolic_tangent(chunk.sdf[i]);
    const Bell<float> b = bell(sdf, inverse_truncation);
    chunk.sdf[i] = sdf;
    chunk.bells[i] = b.value;
    chunk.bell_slopes[i] = b.slope;
  }
}

// Adds d L / d point of sample i to the pose gradient of its ray.
inline void add_sample_gradient(Chunk& chunk, std::int64_t i, const Vec3<float>& by_point) {
  add_point_gradient(by_point, chunk.t[i], chunk.pose_gradients[chunk.ray_of[i]]);
}

// Adds d L / d point of a tile's samples, from gradient rows of the geometry decoder's input.
inline void add_geometry_gradients(const SceneView& scene, const float* grad_x, std::int64_t stride, std::int64_t first,
                                   std::int64_t rows, Chunk& chunk) {
  constexpr int kBytes = static_cast<int>(kFeatureBytes);
  const float inverse_voxel = 1.0f / scene.voxel_size;
  for (std::int64_t r = 0; r < rows; ++r) {
    const float* g = grad_x + r * stride;
    const float* slopes = chunk.slopes + (first + r) * kGeometrySlopes;
    const Feature grad = load_vector<Feature>(g + 3);
    const Vec3<float> by_cell{sum_lanes<float, kBytes>(grad * load_vector<Feature>(slopes)),
                              sum_lanes<float, kBytes>(grad * load_vector<Feature>(slopes + kEmbeddingChannels)),
                              sum_lanes<float, kBytes>(grad * load_vector<Feature>(slopes + 2 * kEmbeddingChannels))};
    const Vec3<float> by_position{g[0], g[1], g[2]};
    add_sample_gradient(chunk, first + r, inverse_voxel * by_cell + scene.position_scale * by_position);
  }
}

// Backward pass from grad_sdf to parameters (added to `partial`, where given), embeddings (rows written to `tables`,
// where given) and rays.
inline void geometry_backward(const SceneView& scene, const PackedMlp<float>& net, const Plan& plan,
                              std::int64_t first_row, const TableGradients& tables, float* partial, Chunk& chunk) {
  const MlpLayout<float>& l = net.layout;
  const std::int64_t n = chunk.num_inside;
#pragma omp simd
  for (std::int64_t i = 0; i < n; ++i) {
    chunk.grad_sdf[i] *= activation_slope(MlpActivation::kTanh, chunk.sdf[i]);
  }
  for (std::int64_t i = n; i < round_up(n, kRowBlock); ++i) chunk.grad_sdf[i] = 0.0f;
  const DecoderRows decoder{n, chunk.x, chunk.h1, chunk.h2, chunk.grad_sdf, 1};
  float* table = plan.embeddings ? tables.embedding + first_row * l.input_stride : nullptr;
  decoder_backward(net, decoder, plan.geometry_params ? partial : nullptr, table, plan.pose, chunk,
                   [&](const float* grad_x, std::int64_t first, std::int64_t rows) {
                     add_geometry_gradients(scene, grad_x, l.input_stride, first, rows, chunk);
                   });
}

// Writes the runs of samples that lie in the same cell; returns how many.
inline std::int64_t store_embedding_runs(const SceneView& scene, std::int64_t first_row, const TableGradients& tables,
                                         const Chunk& chunk) {
  EmbeddingRun* runs = tables.embedding_runs + first_row;
  std::int64_t count = 0;
  for (std::int64_t i = 0; i < chunk.num_inside; ++i) {
    tables.local[first_row + i] = chunk.local[i];
    if (i == 0 || chunk.voxel_of[i] != chunk.voxel_of[i - 1]) {
      EmbeddingRun& run = runs[count++];
      const std::int32_t* corners = scene.corner_ids + kCellCorners * std::int64_t{chunk.voxel_of[i]};
      // In a register: a byte in memory that is read just after it was written is waited for.
      std::uint32_t owned = 0;
      for (int k = 0; k < kCellCorners; ++k) {
        run.corners[k] = corners[k];
        const std::uint32_t part = (static_cast<std::uint32_t>(corners[k]) >> kEmbeddingBlockShift) % kEmbeddingParts;
        owned |= 1u << (kCellCorners * part + k);
      }
      for (int part = 0; part < kEmbeddingParts; ++part) {
        run.owned[part] = static_cast<std::uint8_t>(owned >> (kCellCorners * part));
      }
    }
    runs[count - 1].end = static_cast<std::int32_t>(i + 1);
  }
  return count;
}

}  // namespace spslam::render
