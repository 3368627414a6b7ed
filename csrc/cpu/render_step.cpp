// render_step on the CPU: the forward and backward passes of a chunk of rays while its samples are in the cache.
#include "spslam/render_step.h"

#include "core/parallel.h"
#include "cpu/render_step_cells.h"
#include "cpu/render_step_color.h"
#include "cpu/render_step_geometry.h"
#include "cpu/render_step_losses.h"
#include "cpu/render_step_scatter.h"
#include "kernels/voxel_hash.h"

namespace spslam {
namespace render {
namespace {

// Decoder gradients are summed in this many groups of chunks at most.
constexpr std::int64_t kMaxGroups = 64;

// Results of single rays, summed at the end in the order of the rays.
struct RayResult {
  RayLosses<float> losses;
  PoseGradient pose;
};

class Step {
 public:
  Step(const SceneView& scene, const RayBatch& batch, const RenderOptions& options, const RenderGradients& out)
      : scene_(scene),
        batch_(batch),
        options_(options),
        out_(out),
        plan_(make_plan(options, out)),
        geometry_(kGeometryDecoder, scene.geometry_params),
        color_(kColorDecoder, scene.color_params),
        scale_(mean_scale(options.weights, batch.num_rays)),
        chunks_(chunk_count(batch.num_rays, kChunkRays)),
        chunks_per_group_(chunks_ > kMaxGroups ? chunk_count(chunks_, kMaxGroups) : 1) {}

  void run() {
    reserve();
    parallel_chunks(chunks_, chunks_per_group_, [this](std::int64_t group, std::int64_t begin, std::int64_t end) {
      float* partial = partials_ + group * partial_size();
      for (std::int64_t i = 0; i < partial_size(); ++i) partial[i] = 0.0f;
      for (std::int64_t chunk = begin; chunk < end; ++chunk) run_chunk(chunk, partial);
    });
    if (plan_.embeddings || plan_.texels) {
      parallel_for(kScatterParts, 1, [this](std::int64_t begin, std::int64_t end) {
        for (std::int64_t part = begin; part < end; ++part) {
          scatter_part(scene_, out_, plan_, tables_, chunks_, geometry_.layout.input_stride, part);
        }
      });
    }
    sum_rays();
    sum_partials();
  }

 private:
  static Plan make_plan(const RenderOptions& options, const RenderGradients& out) {
    const bool color = options.weights.rgb != 0.0f;
    return {color,
            out.poses != nullptr,
            out.embeddings != nullptr,
            color && out.texels,
            out.geometry_params != nullptr,
            color && out.color_params};
  }

  static LossWeights mean_scale(const LossWeights& w, std::int64_t rays) {
    const float s = rays > 0 ? 1.0f / static_cast<float>(rays) : 0.0f;
    return {w.rgb * s, w.depth * s, w.free_space * s, w.sdf * s};
  }

  std::int64_t partial_size() const { return geometry_.layout.size + color_.layout.size; }
  std::int64_t num_groups() const { return chunk_count(chunks_, chunks_per_group_); }

  // Memory of the calling thread, kept between calls: allocating pages would take longer than the step itself.
  void reserve() {
    static thread_local ScratchBuffer<float> partials, embedding, texel;
    static thread_local ScratchBuffer<std::int64_t> num_embedding_runs, num_texel_runs;
    static thread_local ScratchBuffer<EmbeddingRun> embedding_runs;
    static thread_local ScratchBuffer<TexelRun> texel_runs;
    static thread_local ScratchBuffer<Vec3<float>> local;
    static thread_local ScratchBuffer<PlaneFraction> fractions;
    static thread_local ScratchBuffer<RayResult> results;
    results_ = results.reserve(batch_.num_rays);
    partials_ = partials.reserve(num_groups() * partial_size());
    tables_ = {};
    tables_.capacity = kChunkRays * options_.sampling.num_samples();
    const std::int64_t rows = tables_.rows = chunks_ * tables_.capacity;
    if (plan_.embeddings) {
      tables_.num_embedding_runs = num_embedding_runs.reserve(chunks_);
      tables_.embedding_runs = embedding_runs.reserve(rows);
      tables_.embedding = embedding.reserve(rows * geometry_.layout.input_stride);
      tables_.local = local.reserve(rows);
    }
    if (plan_.texels) {
      tables_.num_texel_runs = num_texel_runs.reserve(3 * chunks_);
      tables_.texel_runs = texel_runs.reserve(3 * rows);
      tables_.texel = texel.reserve(rows * kPlaneChannels);
      tables_.fractions = fractions.reserve(3 * rows);
    }
  }

  void run_chunk(std::int64_t index, float* partial) const {
    static thread_local Chunk chunk;
    chunk.reserve(options_.sampling.num_samples(), geometry_.layout, color_.layout);
    const std::int64_t begin = index * kChunkRays;
    const std::int64_t end = begin + kChunkRays < batch_.num_rays ? begin + kChunkRays : batch_.num_rays;
    const std::int64_t first_row = index * tables_.capacity;
    const float truncation = options_.sampling.truncation;

    load_rays(batch_, options_, begin, end, chunk);
    sample_rays(scene_, options_, begin, chunk);
    find_cells(scene_, chunk);
    compact_samples(options_, chunk);
    gather_embeddings(scene_, geometry_.layout, plan_.pose, chunk);
    decode_geometry(geometry_, 1.0f / truncation, chunk);
    weigh_samples(truncation, chunk);
    if (plan_.color) {
      gather_texels(scene_, color_.layout, plan_, index, tables_, chunk);
      decode_color(color_, chunk);
    }
    ray_losses(scale_, plan_.color, truncation, chunk);
    if (plan_.color_backward()) {
      color_backward(color_, plan_, first_row, tables_, partial + geometry_.layout.size, chunk);
    }
    if (plan_.geometry_backward()) geometry_backward(scene_, geometry_, plan_, first_row, tables_, partial, chunk);
    if (plan_.embeddings) {
      tables_.num_embedding_runs[index] = store_embedding_runs(scene_, first_row, tables_, chunk);
    }
    store_rays(begin, chunk);
  }

  void store_rays(std::int64_t begin, const Chunk& chunk) const {
    for (std::int64_t i = 0; i < chunk.num_rays; ++i) {
      const Ray& ray = chunk.rays[i];
      results_[begin + i] = {ray.losses, pose_gradient(chunk.pose_gradients[i], ray.direction)};
    }
  }

  void sum_rays() const {
    double sums[4] = {};
    for (std::int64_t r = 0; r < batch_.num_rays; ++r) {
      const RayLosses<float>& l = results_[r].losses;
      const float terms[4] = {l.rgb, l.depth, l.free_space, l.sdf};
      for (int k = 0; k < 4; ++k) sums[k] += terms[k];
    }
    const float weights[4] = {scale_.rgb, scale_.depth, scale_.free_space, scale_.sdf};
    double total = 0.0;
    for (int k = 0; k < 4; ++k) {
      total += weights[k] * sums[k];
      out_.losses[1 + k] = batch_.num_rays > 0 ? static_cast<float>(sums[k] / batch_.num_rays) : 0.0f;
    }
    out_.losses[0] = static_cast<float>(total);
    if (plan_.pose) sum_poses();
  }

  void sum_poses() const {
    for (std::int64_t i = 0; i < batch_.num_frames * kPoseGradientSize; ++i) out_.poses[i] = 0.0f;
    for (std::int64_t r = 0; r < batch_.num_rays;) {
      const std::int32_t frame = batch_.ray_frames[r];
      double sums[kPoseGradientSize] = {};
      for (; r < batch_.num_rays && batch_.ray_frames[r] == frame; ++r) {
        for (int k = 0; k < kPoseGradientSize; ++k) sums[k] += results_[r].pose.values[k];
      }
      if (frame < 0 || frame >= batch_.num_frames) continue;
      for (int k = 0; k < kPoseGradientSize; ++k) {
        out_.poses[frame * kPoseGradientSize + k] += static_cast<float>(sums[k]);
      }
    }
  }

  void sum_partials() const {
    float* total = partials_;
    for (std::int64_t group = 1; group < num_groups(); ++group) {
      const float* partial = partials_ + group * partial_size();
#pragma omp simd
      for (std::int64_t i = 0; i < partial_size(); ++i) total[i] += partial[i];
    }
    store_parameters(geometry_.layout, total, out_.geometry_params);
    store_parameters(color_.layout, total + geometry_.layout.size, out_.color_params);
  }

  void store_parameters(const MlpLayout<float>& layout, const float* padded, float* out) const {
    if (!out) return;
    const bool any = chunks_ > 0;
    layout.for_each_parameter([&](std::int64_t flat, std::int64_t at) { out[flat] = any ? padded[at] : 0.0f; });
  }

  const SceneView& scene_;
  const RayBatch& batch_;
  const RenderOptions& options_;
  const RenderGradients& out_;
  const Plan plan_;
  const PackedMlp<float> geometry_, color_;
  const LossWeights scale_;
  const std::int64_t chunks_, chunks_per_group_;
  float* partials_ = nullptr;
  RayResult* results_ = nullptr;
  TableGradients tables_{};
};

}  // namespace
}  // namespace render

template <>
std::int64_t render_step_workspace_size(Cpu, const SceneView&, const RayBatch&, const RenderOptions&,
                                        const RenderGradients&) {
  return 0;
}

template <>
void render_step(Cpu, const SceneView& scene, const RayBatch& rays, const RenderOptions& options,
                 const RenderGradients& gradients, void*) {
  render::Step(scene, rays, options, gradients).run();
}

}  // namespace spslam
