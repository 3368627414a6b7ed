#include "spslam/orb_features.h"

#include <algorithm>
#include <atomic>
#include <cfloat>
#include <cmath>
#include <cstring>
#include <new>
#include <vector>

#include "core/parallel.h"
#include "cpu/orb_corners.h"
#include "cpu/orb_pyramid.h"
#include "kernels/orb_pattern.h"

namespace spslam {
namespace {

constexpr int kRadius = 15;  // of the round patch that a feature's direction is that of
constexpr int kPatchLanes = 32;
constexpr std::int64_t kDescribed = 64;  // features of a chunk

// parallel_for where f may find no memory: then this does.
template <class F>
void parallel_with_memory(std::int64_t n, std::int64_t grain, const F& f) {
  std::atomic<bool> failed{false};
  parallel_for(n, grain, [&](std::int64_t begin, std::int64_t end) {
    try {
      for (std::int64_t i = begin; i < end; ++i) f(i);
    } catch (const std::bad_alloc&) {
      failed.store(true, std::memory_order_relaxed);
    }
  });
  if (failed.load(std::memory_order_relaxed)) throw std::bad_alloc();
}

struct Feature {
  float x, y, response;  // px of the image
  std::int32_t level, column, row;
  std::int32_t cell, rank;
};

// An image's levels, as it was read and blurred. A thread keeps the memory: the system gives it page by page.
class Levels {
 public:
  std::vector<orb::Level> images, smooth;

  void make(const std::uint8_t* intensity, int height, int width, int edge);
  void blur();

 private:
  ScratchBuffer<std::uint8_t> image_bytes_, smooth_bytes_;
  ScratchBuffer<float> lines_;
};

float scale_of(int level) {
  return static_cast<float>(std::pow(orb::kLevelScale, static_cast<double>(level)));
}

// Those that are large enough to have corners.
void Levels::make(const std::uint8_t* intensity, int height, int width, int edge) {
  images.clear();
  std::int64_t bytes = 0;
  for (int i = 0; i < orb::kLevels; ++i) {
    const float share = 1.0f / scale_of(i);
    const orb::Level level{orb::rounded(height * share), orb::rounded(width * share), nullptr};
    if (std::min(level.rows, level.columns) <= 2 * edge) break;
    images.push_back(level);
    bytes += level.bytes();
  }
  smooth = images;
  std::uint8_t *of_images = image_bytes_.reserve(bytes), *of_smooth = smooth_bytes_.reserve(bytes);
  for (std::size_t i = 0; i < images.size(); ++i) {
    orb::Level& level = images[i];
    level.pixels = of_images;
    smooth[i].pixels = of_smooth;
    of_images += level.bytes();
    of_smooth += level.bytes();
    if (i == 0) {
      for (int y = 0; y < height; ++y) std::memcpy(level.row(y), intensity + std::int64_t{width} * y, width);
    } else {
      orb::resize(images[i - 1], level);
    }
    level.mirror_margin();
  }
}

void Levels::blur() {
  const auto room = [&](std::size_t i) { return (images[i].rows + 6) * std::int64_t{images[i].columns}; };
  std::vector<std::int64_t> first(images.size() + 1);
  for (std::size_t i = 0; i < images.size(); ++i) first[i + 1] = first[i] + room(i);
  float* const lines = lines_.reserve(first.back());
  parallel_for(static_cast<std::int64_t>(images.size()), 1,
               [&](std::int64_t i, std::int64_t) { orb::blur(images[i], smooth[i], lines + first[i]); });
}

// How many corners each level may have: as many as its area has a share in.
void counts_of(int detected, std::size_t* counts) {
  const float factor = static_cast<float>(1.0 / orb::kLevelScale);
  float wanted = detected * (1 - factor) /
                 (1 - static_cast<float>(std::pow(static_cast<double>(factor), static_cast<double>(orb::kLevels))));
  int sum = 0;
  for (int i = 0; i < orb::kLevels - 1; ++i) {
    counts[i] = static_cast<std::size_t>(orb::rounded(wanted));
    sum += static_cast<int>(counts[i]);
    wanted *= factor;
  }
  counts[orb::kLevels - 1] = static_cast<std::size_t>(std::max(detected - sum, 0));
}

std::vector<Feature> detected(const Levels& levels, const OrbOptions& options, int width) {
  std::size_t counts[orb::kLevels];
  counts_of(options.detected, counts);
  const float per_px = static_cast<float>(static_cast<double>(options.cell_columns) / width);
  const auto threshold = static_cast<std::uint8_t>(options.fast_threshold);
  std::vector<orb::Corner> corners[orb::kLevels];
  parallel_with_memory(static_cast<std::int64_t>(levels.images.size()), 1, [&](std::int64_t i) {
    corners[i] = orb::corners_of(levels.images[i], options.edge_px, threshold, counts[i]);
  });
  std::vector<Feature> features;
  for (int i = 0; i < static_cast<int>(levels.images.size()); ++i) {
    const float scale = scale_of(i);
    for (const orb::Corner& corner : corners[i]) {
      const float x = corner.x * scale, y = corner.y * scale;
      const auto column = static_cast<std::int32_t>(x * per_px), row = static_cast<std::int32_t>(y * per_px);
      features.push_back({x, y, corner.response, i, corner.x, corner.y, row * options.cell_columns + column, 0});
    }
  }
  return features;
}

// The strongest of each cell, then the second ones, and so on, each the strongest first.
void spread(std::vector<Feature>& features) {
  std::sort(features.begin(), features.end(), [](const Feature& a, const Feature& b) {
    if (a.cell != b.cell) return a.cell < b.cell;
    if (a.response != b.response) return a.response > b.response;
    return a.y != b.y ? a.y < b.y : a.x < b.x;
  });
  for (std::size_t i = 1; i < features.size(); ++i) {
    features[i].rank = features[i].cell == features[i - 1].cell ? features[i - 1].rank + 1 : 0;
  }
  std::stable_sort(features.begin(), features.end(), [](const Feature& a, const Feature& b) {
    return a.rank != b.rank ? a.rank < b.rank : a.response > b.response;
  });
}

// Weights of the pixels of a patch's row, from the sixteenth to the left of its middle on: 1 inside, and the column.
struct PatchRow {
  std::int16_t inside[kPatchLanes], column[kPatchLanes];
};

// The rows of a round patch, symmetrical in rows and columns.
struct Patch {
  PatchRow rows[kRadius + 1];

  Patch() {
    int reach[kRadius + 2];
    const int last = static_cast<int>(std::floor(kRadius * std::sqrt(2.0f) / 2 + 1)),
              first = static_cast<int>(std::ceil(kRadius * std::sqrt(2.0f) / 2));
    for (int v = 0; v <= last; ++v) reach[v] = orb::rounded(std::sqrt(double{kRadius} * kRadius - v * v));
    for (int v = kRadius, before = 0; v >= first; --v) {
      while (reach[before] == reach[before + 1]) ++before;
      reach[v] = before++;
    }
    for (int v = 0; v <= kRadius; ++v) {
      for (int i = 0; i < kPatchLanes; ++i) {
        const int u = i - kPatchLanes / 2;
        rows[v].inside[i] = static_cast<std::int16_t>(u >= -reach[v] && u <= reach[v]);
        rows[v].column[i] = static_cast<std::int16_t>(u * rows[v].inside[i]);
      }
    }
  }
};

// The angle of (x, y) in degrees, 0 to 360, to some 0.01: OpenCV's polynomial.
float angle_of(float y, float x) {
  constexpr float kDegrees = static_cast<float>(180 / 3.1415926535897932384626433832795);
  constexpr float k1 = 0.9997878412794807f * kDegrees, k3 = -0.3258083974640975f * kDegrees,
                  k5 = 0.1555786518463281f * kDegrees, k7 = -0.04432655554792128f * kDegrees;
  const float across = std::fabs(x), up = std::fabs(y);
  const float share = std::min(across, up) / (std::max(across, up) + static_cast<float>(DBL_EPSILON));
  const float squared = share * share;
  float angle = (((k7 * squared + k5) * squared + k3) * squared + k1) * share;
  if (across < up) angle = 90.0f - angle;
  if (x < 0) angle = 180.0f - angle;
  return y < 0 ? 360.0f - angle : angle;
}

// The direction from a corner to the center of brightness of the patch around it, degrees.
float direction(const orb::Level& image, int x, int y) {
  static const Patch patch;
  std::int32_t along_x = 0, along_y = 0;
  for (int v = -kRadius; v <= kRadius; ++v) {
    const PatchRow& row = patch.rows[std::abs(v)];
    const std::uint8_t* const pixels = image.row(y + v) + x - kPatchLanes / 2;
    std::int32_t sum = 0, moment = 0;
    for (int i = 0; i < kPatchLanes; ++i) {
      sum += row.inside[i] * static_cast<std::int16_t>(pixels[i]);
      moment += row.column[i] * static_cast<std::int16_t>(pixels[i]);
    }
    along_x += moment;
    along_y += v * sum;
  }
  return angle_of(static_cast<float>(along_y), static_cast<float>(along_x));
}

// The pattern's coordinates as numbers that vectors are made of.
struct Pattern {
  float x[2 * kOrbBits], y[2 * kOrbBits];  // first pixels, then second ones

  Pattern() {
    for (int i = 0; i < kOrbBits; ++i) {
      x[i] = kOrbPattern[i].x0;
      y[i] = kOrbPattern[i].y0;
      x[kOrbBits + i] = kOrbPattern[i].x1;
      y[kOrbBits + i] = kOrbPattern[i].y1;
    }
  }
};

// The nearest whole number of one below 2^21, the even one from the middle.
inline std::int32_t nearest(float value) {
  constexpr float kShift = 12582912.0f;  // of 1.5 2^23, where a float has no fraction
  const float shifted = value + kShift;
  std::int32_t bits;
  std::memcpy(&bits, &shifted, sizeof bits);
  return bits - 0x4B400000;
}

void describe(const orb::Level& smooth, int column, int row, float degrees, std::uint8_t* descriptor) {
  static const Pattern pattern;
  const float radians = degrees * static_cast<float>(3.1415926535897932384626433832795 / 180.0);
  const float a = std::cos(radians), b = std::sin(radians);
  const std::uint8_t* const center = smooth.row(row) + column;
  const auto stride = static_cast<std::int32_t>(smooth.stride());
  std::int32_t offsets[2 * kOrbBits];
  for (int i = 0; i < 2 * kOrbBits; ++i) {
    const std::int32_t x = nearest(pattern.x[i] * a - pattern.y[i] * b),
                       y = nearest(pattern.x[i] * b + pattern.y[i] * a);
    offsets[i] = y * stride + x;
  }
  for (int byte = 0; byte < kOrbBytes; ++byte) {
    unsigned bits = 0;
    for (int k = 0; k < 8; ++k) {
      const int i = 8 * byte + k;
      bits |= static_cast<unsigned>(center[offsets[i]] < center[offsets[kOrbBits + i]]) << k;
    }
    descriptor[byte] = static_cast<std::uint8_t>(bits);
  }
}

}  // namespace

std::int64_t orb_features(Cpu, const std::uint8_t* intensity, std::int32_t height, std::int32_t width,
                          const OrbOptions& options, float* positions, std::uint8_t* descriptors) {
  thread_local Levels levels;
  levels.make(intensity, height, width, std::max(options.edge_px, kRadius + 1));
  std::vector<Feature> features = detected(levels, options, width);
  spread(features);
  if (features.size() > static_cast<std::size_t>(options.count)) features.resize(options.count);
  levels.blur();
  const Levels& own = levels;  // in the lambda `levels` would be those of the thread that runs it
  parallel_for(static_cast<std::int64_t>(features.size()), kDescribed, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const Feature& one = features[i];
      positions[2 * i] = one.x;
      positions[2 * i + 1] = one.y;
      const float degrees = direction(own.images[one.level], one.column, one.row);
      describe(own.smooth[one.level], one.column, one.row, degrees, descriptors + kOrbBytes * i);
    }
  });
  return static_cast<std::int64_t>(features.size());
}

}  // namespace spslam
