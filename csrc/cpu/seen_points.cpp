#include "launch/seen_points.h"

#include <algorithm>

#include "cpu/simd.h"

namespace spslam {
namespace {

// Points that are worked on together, and pixels.
constexpr int kPointLanes = 64;
constexpr std::int64_t kRunGrain = 1, kRowGrain = 16;
static_assert(kSeenRun % kPointLanes == 0, "a run must be whole batches");

// Coordinates [count, 3] as one array per axis; lanes without any are NaN.
void load_axes(const float* from, int count, float* x, float* y, float* z) {
  if (count == kPointLanes) {
    SPS_SIMD for (int m = 0; m < kPointLanes; ++m) x[m] = from[3 * m], y[m] = from[3 * m + 1], z[m] = from[3 * m + 2];
    return;
  }
  std::fill_n(x, kPointLanes, NAN);
  std::fill_n(y, kPointLanes, NAN);
  std::fill_n(z, kPointLanes, NAN);
  for (int m = 0; m < count; ++m) x[m] = from[3 * m], y[m] = from[3 * m + 1], z[m] = from[3 * m + 2];
}

// Where a batch of points falls.
struct PlacedPoints {
  alignas(64) float x[kPointLanes], y[kPointLanes], z[kPointLanes];  // world
  alignas(64) float u[kPointLanes], v[kPointLanes], depth[kPointLanes];
  // The nearest pixel's place in the depth buffer, and in the image, -1 outside.
  alignas(64) std::int32_t drawn[kPointLanes], pixel[kPointLanes];

  // Of the points [first, first + count); returns whether any is in the image. Not inlined, so that the same points
  // fall on the same pixels wherever it is called.
  __attribute__((noinline)) bool place(const SeenSurface& surface, std::int64_t first, int count,
                                       const SeenFrame& frame, const Pose<float>& pose) {
    load_axes(surface.points + 3 * first, count, x, y, z);
    // Copies, as what the loop writes might else be part of what it reads.
    const SeenFrame view = frame;
    const Pose<float> seen_from = pose;
    const std::int32_t stride = static_cast<std::int32_t>(drawn_stride(frame));
    std::int32_t last = -1;
#pragma omp simd reduction(max : last)
    for (int m = 0; m < kPointLanes; ++m) {
      const SeenPlace at = seen_place(view, seen_from, {x[m], y[m], z[m]});
      const float column = at.u, row = at.v, away = at.z;
      const std::int32_t in_image = nearest_pixel(view, column, row, away, view.width);
      u[m] = column;
      v[m] = row;
      depth[m] = away;
      drawn[m] = nearest_pixel(view, column, row, away, stride) + stride + 1;
      pixel[m] = in_image;
      last = in_image > last ? in_image : last;
    }
    return last >= 0;
  }
};

// A number of a depth buffer becomes the smaller one. Of positive numbers the bits are in the same order; whatever the
// order of the threads, the least one stays.
void lower(float* number, float to) {
  std::int32_t bits, now;
  __builtin_memcpy(&bits, &to, sizeof bits);
  std::int32_t* place = reinterpret_cast<std::int32_t*>(number);
  __atomic_load(place, &now, __ATOMIC_RELAXED);
  while (bits < now && !__atomic_compare_exchange(place, &now, &bits, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
}

// Calls visit(first, count) for the batches of the runs that reach into the view, and pass(first, count) for the other
// runs as a whole.
template <class Visit, class Pass>
void for_each_batch(const SeenSurface& surface, const SeenFrame& frame, const Pose<float>& pose, const Visit& visit,
                    const Pass& pass) {
  parallel_for(chunk_count(surface.count, kSeenRun), kRunGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t run = begin; run < end; ++run) {
      const std::int64_t first = run * kSeenRun, last = std::min<std::int64_t>(first + kSeenRun, surface.count);
      if (!sphere_in_view(frame, pose, surface.spheres + 4 * run)) {
        pass(first, last - first);
        continue;
      }
      for (std::int64_t at = first; at < last; at += kPointLanes) {
        visit(at, static_cast<int>(std::min<std::int64_t>(kPointLanes, last - at)));
      }
    }
  });
}

// The depth buffer: first the nearest points, then with gaps between them closed.
class DrawnDepth {
 public:
  DrawnDepth(const SeenFrame& frame, float* memory)
      : frame_(frame),
        stride_(drawn_stride(frame)),
        drawn_(memory),
        lowest_(memory + stride_ * (std::int64_t{frame.height} + 2)) {
    parallel_for(std::int64_t{frame.height} + 2, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
      std::fill(drawn_ + begin * stride_, drawn_ + end * stride_, kNothingDrawn);
      std::fill(lowest_ + begin * stride_, lowest_ + end * stride_, 0.0f);
    });
  }

  void draw(const PlacedPoints& points) {
    for (int m = 0; m < kPointLanes; ++m) {
      if (points.pixel[m] >= 0) lower(drawn_ + points.drawn[m], points.depth[m]);
    }
  }

  void close_gaps() {
    for_each_row([this](std::int64_t row) {
      const float* own = drawn_ + row * stride_;
      float* to = lowest_ + row * stride_;
      SPS_SIMD for (std::int32_t u = 1; u <= frame_.width; ++u) to[u] = least_around(own + u, stride_);
    });
    for_each_row([this](std::int64_t row) {
      const float* own = lowest_ + row * stride_;
      float* to = drawn_ + row * stride_;
      SPS_SIMD for (std::int32_t u = 1; u <= frame_.width; ++u) to[u] = smaller(to[u], most_around(own + u, stride_));
    });
  }

  float front(std::int32_t place) const { return drawn_[place]; }

 private:
  template <class F>
  void for_each_row(const F& f) {
    parallel_for(frame_.height, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t row = begin + 1; row <= end; ++row) f(row);
    });
  }

  const SeenFrame& frame_;
  std::int64_t stride_;
  float *drawn_, *lowest_;
};

// Writes weights and colors of a batch, of which some are in the image.
void look_at(const SeenSurface& surface, std::int64_t first, int count, const PlacedPoints& points,
             const SeenFrame& frame, const Pose<float>& pose, const DrawnDepth& drawn, std::uint8_t* colors,
             float* weights) {
  alignas(64) float nx[kPointLanes], ny[kPointLanes], nz[kPointLanes];
  alignas(64) float front[kPointLanes], measured[kPointLanes], weight[kPointLanes];
  load_axes(surface.normals + 3 * first, count, nx, ny, nz);
  for (int m = 0; m < kPointLanes; ++m) {
    const std::int32_t pixel = points.pixel[m];
    front[m] = pixel < 0 ? 0.0f : drawn.front(points.drawn[m]);
    measured[m] = pixel < 0 ? 0.0f : frame.depth[pixel];
  }
  const SeenFrame view = frame;
  const Pose<float> seen_from = pose;
  SPS_SIMD for (int m = 0; m < kPointLanes; ++m) {
    const float cosine = seen_cosine(seen_from, {points.x[m], points.y[m], points.z[m]}, {nx[m], ny[m], nz[m]});
    const float seen = seen_weight(view, points.depth[m], cosine, front[m], measured[m]);
    weight[m] = points.pixel[m] >= 0 ? seen : 0.0f;
  }
  for (int m = 0; m < count; ++m) {
    std::uint8_t* color = colors + 3 * (first + m);
    weights[first + m] = weight[m];
    if (weight[m] > 0.0f) {
      seen_color(frame, points.u[m], points.v[m], color);
    } else {
      color[0] = color[1] = color[2] = 0;
    }
  }
}

}  // namespace

template <>
void see_points<Cpu>(Cpu, const SeenSurface& surface, const SeenFrame& frame, std::uint8_t* colors, float* weights,
                     void* workspace) {
  const Pose<float> pose = load_pose(frame.pose);
  DrawnDepth drawn(frame, static_cast<float*>(workspace));
  for_each_batch(
      surface, frame, pose,
      [&](std::int64_t first, int count) {
        PlacedPoints points;
        if (points.place(surface, first, count, frame, pose)) drawn.draw(points);
      },
      [](std::int64_t, std::int64_t) {});
  drawn.close_gaps();
  const auto nothing = [&](std::int64_t first, std::int64_t count) {
    std::fill_n(weights + first, count, 0.0f);
    std::fill_n(colors + 3 * first, 3 * count, std::uint8_t{0});
  };
  for_each_batch(
      surface, frame, pose,
      [&](std::int64_t first, int count) {
        PlacedPoints points;
        if (points.place(surface, first, count, frame, pose)) {
          look_at(surface, first, count, points, frame, pose, drawn, colors, weights);
        } else {
          nothing(first, count);
        }
      },
      nothing);
}

SPS_INSTANTIATE_SEEN_POINTS(Cpu)

}  // namespace spslam
