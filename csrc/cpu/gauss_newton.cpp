#include "spslam/gauss_newton.h"

#include "core/for_each.h"
#include "cpu/scene_tile.h"
#include "kernels/depth_keyframes.h"
#include "kernels/gauss_newton.h"
#include "kernels/reference_image.h"
#include "kernels/voxel_hash.h"

namespace spslam {
namespace {

// Pixels summed by one worker before its sums are added to the others', in order.
constexpr std::int64_t kPixelGrain = 2 * kTileRows;

struct Measurement {
  Intrinsics camera;
  float truncation;
  KernelWidths kernel;
  float noise_crossover_depth;
  ReferenceView reference;
  DepthKeyframes views;
  DepthKeyframe view[kMaxDepthKeyframes];
};

// terms: of the map and, from kTrackingTerms on, of the views.
void add_views(const Measurement& measure, const SurfacePoint& point, float certainty, const MapResidual& map,
               double* terms) {
  for (int k = 0; k < measure.views.count; ++k) {
    add_depth_keyframe_residual(measure.views, measure.view[k], point.world, point.offset, measure.kernel.view,
                                certainty, map, terms + kTrackingTerms);
  }
}

// Sums over pixels [begin, end), whose records `record(i)` gives.
template <class Record>
void add_pixels(const SceneView& scene, const PackedMlp<float>& net, const Measurement& measure,
                const Pose<float>& pose, std::int64_t begin, std::int64_t end, const Record& record, double* terms) {
  const Intrinsics& camera = measure.camera;
  GeometryTile tile(net);
  SurfacePoint points[kTileRows];
  Vec3<float> gradients[kTileRows];
  float sdf[kTileRows], certainty[kTileRows];
  const float inverse_voxel = 1.0f / scene.voxel_size;
  const auto flush = [&] {
    tile.decode(sdf);
    tile.position_gradient(scene, gradients);
    for (std::int64_t i = 0; i < tile.size(); ++i) {
      const bool known = is_tracking_inlier(1.0f, true, sdf[i]);
      add_views(measure, points[i], certainty[i], {sdf[i] * measure.truncation, known}, terms);
      if (!known) continue;
      add_tracking_residual(points[i].offset, sdf[i], gradients[i], measure.truncation, measure.kernel, certainty[i],
                            terms);
    }
    tile.clear();
  };
  for (std::int64_t i = begin; i < end; ++i) {
    const Pixel pixel = unpack_pixel(record(i));
    if (!(pixel.depth > 0.0f)) continue;
    const SurfacePoint point = surface_point(pixel, pose, camera.fx, camera.fy, camera.cx, camera.cy);
    if (measure.reference.image.height > 0) {
      add_intensity_residual(measure.reference, pixel, point.world, point.offset, terms);
    }
    const Cell<float> cell = find_cell(scene.table, scene.corner_ids, inverse_voxel * point.world);
    const float certain = depth_certainty(pixel.depth, measure.noise_crossover_depth);
    if (!cell.corner_ids) {
      add_views(measure, point, certain, {0.0f, false}, terms);
      continue;
    }
    points[tile.size()] = point;
    certainty[tile.size()] = certain;
    tile.add(scene, point.world, cell);
    if (tile.full()) flush();
  }
  if (tile.size()) flush();
}

// terms[kJointTerms] = sums over all n pixels, chunk by chunk in order, whatever the number of threads.
template <class Record>
void sum_pixels(const SceneView& scene, const PackedMlp<float>& net, const Measurement& measure,
                const Pose<float>& pose, std::int64_t n, const Record& record, double* partials, double* terms) {
  parallel_chunks(n, kPixelGrain, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
    double* own = partials + chunk * kJointTerms;
    for (int t = 0; t < kJointTerms; ++t) own[t] = 0.0;
    add_pixels(scene, net, measure, pose, begin, end, record, own);
  });
  for (int t = 0; t < kJointTerms; ++t) terms[t] = 0.0;
  for (std::int64_t chunk = 0; chunk < chunk_count(n, kPixelGrain); ++chunk) {
    for (int t = 0; t < kJointTerms; ++t) terms[t] += partials[chunk * kJointTerms + t];
  }
}

}  // namespace

template <>
void predict_pose<Cpu>(Cpu device, const float* before, const float* last, float* next) {
  for_each(device, 1, [=](std::int64_t) { constant_speed_pose(before, last, next); });
}

template <>
std::int64_t gauss_newton_workspace_size<Cpu>(Cpu, std::int64_t frames, std::int64_t pixels) {
  const std::int64_t chunks = chunk_count(pixels, kPixelGrain);
  return (frames > 0 ? frames : 1) * (chunks > 0 ? chunks : 1) * kJointTerms *
         static_cast<std::int64_t>(sizeof(double));
}

template <>
void track_gauss_newton<Cpu>(Cpu, const SceneView& scene, const std::int32_t* pixels, std::int64_t num_records,
                             const TrackingOptions& options, void* workspace, float* pose, float* stats,
                             float* hessian) {
  const PackedMlp<float> net(kGeometryDecoder, scene.geometry_params);
  double terms[kJointTerms], joint[kNormalTerms];
  Measurement measure{options.intrinsics,
                      options.truncation,
                      {},
                      options.noise_crossover_depth,
                      load_reference(options.reference),
                      options.views,
                      {}};
  for (int k = 0; k < options.views.count; ++k) measure.view[k] = load_depth_keyframe(options.views, k);
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    PhiloxKey key = options.key;
    key.iteration = static_cast<std::uint32_t>(iteration);
    const auto record = [&](std::int64_t i) {
      return pixels +
             kPixelWords * philox_index(key, static_cast<std::uint32_t>(i), static_cast<std::uint64_t>(num_records));
    };
    measure.kernel = tracking_kernel(options, iteration);
    measure.views.count = keyframes_in_use(options.views, iteration);
    sum_pixels(scene, net, measure, load_pose(pose), options.num_pixels, record, static_cast<double*>(workspace),
               terms);
    float* own_stats = stats + kTrackingStatSize * iteration;
    tracking_fit(terms, options.num_pixels, own_stats);
    join_keyframe_terms(terms, terms + kTrackingTerms, measure.views.count, joint);
    tracking_step(terms, joint, options.damping, pose, own_stats + 2, hessian);
  }
}

template <>
void gauss_newton_poses<Cpu>(Cpu, const SceneView& scene, const std::int32_t* pixels, const float* poses,
                             std::int64_t frames, std::int64_t pixels_per_frame, const Intrinsics& intrinsics,
                             float truncation, float kernel, void* workspace, float* hessian, float* gradient,
                             float* cost, float* inliers) {
  const PackedMlp<float> net(kGeometryDecoder, scene.geometry_params);
  double* partials = static_cast<double*>(workspace);
  const Measurement measure{intrinsics, truncation, {kernel, kernel, kernel}, 0.0f, {}, {}, {}};
  // Frames run side by side; within one, the loop over its pixels is nested and so runs in place.
  const std::int64_t share = chunk_count(pixels_per_frame, kPixelGrain) * kJointTerms;
  parallel_for(frames, 1, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t f = begin; f < end; ++f) {
      const auto record = [&](std::int64_t i) { return pixels + kPixelWords * (f * pixels_per_frame + i); };
      double terms[kJointTerms], total;
      sum_pixels(scene, net, measure, load_pose(poses + kPoseSize * f), pixels_per_frame, record, partials + f * share,
                 terms);
      double h[36], g[6];
      store_normal_terms<double>(terms, h, g, &total);
      for (int i = 0; i < 36; ++i) hessian[36 * f + i] = static_cast<float>(h[i]);
      for (int i = 0; i < 6; ++i) gradient[6 * f + i] = static_cast<float>(g[i]);
      cost[f] = static_cast<float>(tracking_cost(terms));
      inliers[f] = pixels_per_frame ? static_cast<float>(terms[kNormalTerms + 1] / double(pixels_per_frame)) : 0.0f;
    }
  });
}

}  // namespace spslam
