#include "spslam/gauss_newton.h"

#include <algorithm>

#include "core/for_each.h"
#include "cpu/keyframe_prefetch.h"
#include "cpu/scene_tile.h"
#include "cpu/term_sums.h"
#include "kernels/gauss_newton.h"
#include "kernels/voxel_hash.h"

namespace spslam {
namespace {

// Pixels summed by one worker before its sums are added to the others', in order.
constexpr std::int64_t kPixelGrain = 2 * kTileRows;

// Pixels on their way: an iteration draws others than the one before, and the tables and images that they are looked up
// in are far larger than the caches. So every look-up is a pass of its own, which prefetches what the next one reads.
class DrawnPixels {
 public:
  // Reads count records, record(i) for i from 0 on, and looks up the cells around the points that they show.
  template <class Record>
  void look_up(const SceneView& scene, const Measurement& measure, const Pose<float>& pose, std::int64_t count,
               const Record& record) {
    const std::int32_t* records[kPointsAhead];
    for (std::int64_t i = 0; i < count; ++i) __builtin_prefetch(records[i] = record(i));
    size = 0;
    for (std::int64_t i = 0; i < count; ++i) {
      pixels[size] = unpack_pixel(records[i]);
      if (!(pixels[size].depth > 0.0f)) continue;
      points[size] = surface_point(pixels[size], pose, measure.options->intrinsics);
      const Vec3<float> point_vox = (1.0f / scene.voxel_size) * points[size].world;
      const Vec3<float> base = rounded_down(point_vox);
      keys_[size] = cell_key(base);
      cells[size].local = point_vox - base;
      const std::int64_t slot = voxel_slot(keys_[size], scene.table.mask);
      __builtin_prefetch(scene.table.keys + slot);
      __builtin_prefetch(scene.table.values + slot);
      for (int k = 0; k < measure.num_keyframes; ++k) {
        prefetch_keyframe(measure.options->depth_keyframes, measure.frames->keyframes[k], points[size].world);
      }
      ++size;
    }
    for (std::int64_t i = 0; i < size; ++i) {
      ids_[i] = keys_[i] == kEmptyVoxelKey ? kNoVoxel : find_voxel_key(scene.table, keys_[i]);
      if (ids_[i] != kNoVoxel) __builtin_prefetch(scene.corner_ids + std::int64_t{kCellCorners} * ids_[i]);
    }
    for (std::int64_t i = 0; i < size; ++i) {
      cells[i] = cell_of_voxel(scene.corner_ids, scene.num_voxels, ids_[i], cells[i].local);
      if (!cells[i].corner_ids) continue;
      for (int k = 0; k < kCellCorners; ++k) {
        __builtin_prefetch(scene.embeddings + kEmbeddingChannels * std::int64_t{cells[i].corner_ids[k]});
      }
    }
  }

  // Of those with a depth.
  std::int64_t size = 0;
  Pixel pixels[kPointsAhead];
  SurfacePoint points[kPointsAhead];
  Cell<float> cells[kPointsAhead];

 private:
  std::int64_t keys_[kPointsAhead];
  std::int32_t ids_[kPointsAhead];
};

// Sums over pixels [begin, end), whose records `record(i)` gives: terms of the map and, from kTrackingTerms on, of the
// depth keyframes and of the gain.
template <class Record>
void add_pixels(const SceneView& scene, const PackedMlp<float>& net, const Measurement& measure,
                const Pose<float>& pose, std::int64_t begin, std::int64_t end, const Record& record, double* terms) {
  const GaussNewtonOptions& options = *measure.options;
  GeometryTile tile(net);
  DrawnPixels drawn;
  SurfacePoint points[kTileRows];
  Pixel pixels[kTileRows];
  Vec3<float> gradients[kTileRows];
  PixelNoise noise[kTileRows];
  float sdf[kTileRows];
  double* const keyframe_terms = terms + kTrackingTerms;
  double* const gain_terms = keyframe_terms + kKeyframeTerms;
  const auto add_keyframes = [&](const Pixel& pixel, const SurfacePoint& point, const PixelNoise& own,
                                 const MapResidual& map) {
    add_keyframe_residuals(measure, pixel, point, own, map, 0, 1, keyframe_terms, gain_terms + kGainTerms);
  };
  const auto flush = [&] {
    tile.decode(sdf);
    tile.position_gradient(scene, gradients);
    for (std::int64_t i = 0; i < tile.size(); ++i) {
      const bool known = is_tracking_inlier(1.0f, true, sdf[i]);
      add_keyframes(pixels[i], points[i], noise[i], {sdf[i] * options.truncation, known});
      if (known) add_map_residual(measure, points[i].offset, sdf[i], gradients[i], noise[i].map_certainty, terms);
    }
    tile.clear();
  };
  for (std::int64_t first = begin; first < end; first += kPointsAhead) {
    drawn.look_up(scene, measure, pose, std::min(end - first, kPointsAhead),
                  [&](std::int64_t i) { return record(first + i); });
    for (std::int64_t i = 0; i < drawn.size; ++i) {
      const Pixel& pixel = drawn.pixels[i];
      const SurfacePoint& point = drawn.points[i];
      add_reference_residual(measure, pixel, point, terms, gain_terms);
      const PixelNoise own = noise_of(measure, pixel);
      if (!drawn.cells[i].corner_ids) {
        add_keyframes(pixel, point, own, {0.0f, false});
        continue;
      }
      points[tile.size()] = point;
      pixels[tile.size()] = pixel;
      noise[tile.size()] = own;
      tile.add(scene, point.world, drawn.cells[i]);
      if (tile.full()) flush();
    }
  }
  if (tile.size()) flush();
}

// terms[kJointTerms] = sums over all n pixels.
template <class Record>
void sum_pixels(const SceneView& scene, const PackedMlp<float>& net, const Measurement& measure,
                const Pose<float>& pose, std::int64_t n, const Record& record, double* partials, double* terms) {
  sum_terms<kJointTerms>(n, kPixelGrain, partials, terms, [&](std::int64_t begin, std::int64_t end, double* own) {
    add_pixels(scene, net, measure, pose, begin, end, record, own);
  });
}

}  // namespace

template <>
void predict_pose<Cpu>(Cpu device, const RecentMotion& motion, float* next) {
  for_each(device, 1, [=](std::int64_t) { constant_speed_pose(motion, next); });
}

template <>
std::int64_t gauss_newton_workspace_size<Cpu>(Cpu, std::int64_t frames, std::int64_t pixels) {
  const std::int64_t chunks = chunk_count(pixels, kPixelGrain);
  return (frames > 0 ? frames : 1) * (chunks > 0 ? chunks : 1) * kJointTerms *
         static_cast<std::int64_t>(sizeof(double));
}

template <>
void track_gauss_newton<Cpu>(Cpu, const SceneView& scene, const std::int32_t* pixels, std::int64_t num_records,
                             const GaussNewtonOptions& options, void* workspace, float* pose, float* stats,
                             float* hessian) {
  if (options.wanted && *options.wanted != 1.0f) return;
  const PackedMlp<float> net(kGeometryDecoder, scene.geometry_params);
  double terms[kJointTerms], joint[kJointNormals];
  EarlierFrames frames{};
  for (int i = 0; i < kMaxEarlierFrames; ++i) load_earlier_frame(options, i, frames);
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    PhiloxKey key = options.key;
    key.iteration = static_cast<std::uint32_t>(iteration);
    const auto record = [&](std::int64_t i) {
      return pixels +
             kPixelWords * philox_index(key, static_cast<std::uint32_t>(i), static_cast<std::uint64_t>(num_records));
    };
    const Measurement measure = measurement(options, &frames, iteration);
    load_colors(options, pose, frames);
    sum_pixels(scene, net, measure, load_pose(pose), options.num_pixels, record, static_cast<double*>(workspace),
               terms);
    float* own_stats = stats + kFrameStatSize * iteration;
    tracking_fit(terms, options.num_pixels, own_stats);
    const double* keyframe_terms = terms + kTrackingTerms;
    join_keyframe_terms(terms, keyframe_terms, keyframe_terms + kKeyframeTerms, measure.num_keyframes, joint);
    FrameGain* gain = options.depth_keyframes.log_gains ? &frames.gain : nullptr;
    const float variance = gain ? gain_variance(joint, *gain) : 0.0f;
    tracking_step(terms, joint, options.damping, held_damping(measure, terms), pose, own_stats + 2, hessian, gain);
    own_stats[kTrackingStatSize] = frames.gain.log_gain;
    own_stats[kTrackingStatSize + 1] = variance;
  }
}

template <>
void gauss_newton_poses<Cpu>(Cpu, const SceneView& scene, const std::int32_t* pixels, const float* poses,
                             std::int64_t frames, std::int64_t pixels_per_frame, const Intrinsics& intrinsics,
                             float truncation, float kernel, void* workspace, const PoseEquations& out) {
  const PackedMlp<float> net(kGeometryDecoder, scene.geometry_params);
  double* partials = static_cast<double*>(workspace);
  const GaussNewtonOptions options = map_options(intrinsics, truncation, kernel);
  const Measurement measure = measurement(options, nullptr, 0);
  // Frames run side by side; within one, the loop over its pixels is nested and so runs in place.
  const std::int64_t share = chunk_count(pixels_per_frame, kPixelGrain) * kJointTerms;
  parallel_for(frames, 1, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t f = begin; f < end; ++f) {
      const auto record = [&](std::int64_t i) { return pixels + kPixelWords * (f * pixels_per_frame + i); };
      double terms[kJointTerms];
      sum_pixels(scene, net, measure, load_pose(poses + kPoseSize * f), pixels_per_frame, record, partials + f * share,
                 terms);
      store_pose_equations(terms, f, pixels_per_frame, out);
    }
  });
}

}  // namespace spslam
