// Corners of one level: FAST (Rosten and Drummond 2006) of nine of sixteen pixels, the best by Harris's measure.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <functional>
#include <vector>

#include "cpu/orb_pyramid.h"
#include "cpu/simd.h"

namespace spslam {
namespace orb {

struct Corner {
  std::int32_t x, y;  // px of the level
  float response;
};

// The circle of sixteen pixels.
constexpr int kCircle = 16;
constexpr int kCircleX[kCircle] = {0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1};
constexpr int kCircleY[kCircle] = {3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1, 0, 1, 2, 3};

using Bytes = Vector<std::uint8_t>;

struct Darker {
  static inline Bytes of(const Bytes& a, const Bytes& b) { return a < b ? a : b; }
};
struct Brighter {
  static inline Bytes of(const Bytes& a, const Bytes& b) { return a > b ? a : b; }
};

// Of all arcs of nine pixels of a circle the one whose `Of` (the darkest, say) is best by `Best` (the brightest).
template <class Of, class Best>
inline Bytes best_arc(const Bytes* circle) {
  Bytes two[kCircle], four[kCircle], best;
  for (int i = 0; i < kCircle; ++i) two[i] = Of::of(circle[i], circle[(i + 1) % kCircle]);
  for (int i = 0; i < kCircle; ++i) four[i] = Of::of(two[i], two[(i + 2) % kCircle]);
  for (int i = 0; i < kCircle; ++i) {
    const Bytes nine = Of::of(Of::of(four[i], four[(i + 4) % kCircle]), circle[(i + 8) % kCircle]);
    best = i ? Best::of(best, nine) : nine;
  }
  return best;
}

// How much brighter or darker than the pixel nine pixels in a row around it are, at least; 0 up to the threshold.
// Of `width` pixels from (x, y) on; what `scores` has behind them up to a vector is written too.
inline void fast_scores(const Level& image, int y, int x, int width, std::uint8_t threshold, std::uint8_t* scores) {
  const std::uint8_t* const line = image.row(y) + x;
  for (int i = 0; i < width; i += kLanes<std::uint8_t>) {
    Bytes circle[kCircle];
    for (int k = 0; k < kCircle; ++k) {
      circle[k] = load_vector<Bytes>(line + i + kCircleY[k] * image.stride() + kCircleX[k]);
    }
    const Bytes center = load_vector<Bytes>(line + i);
    const Bytes bright = best_arc<Darker, Brighter>(circle), dark = best_arc<Brighter, Darker>(circle);
    const Bytes above = Brighter::of(bright, center) - center, below = center - Darker::of(dark, center);
    const Bytes score = Brighter::of(above, below);
    store_vector(scores + i, score > threshold ? score : Bytes{});
  }
}

// Keeps the `count` corners of the largest responses, and those of the same response as the last of these.
inline void keep_best(std::vector<Corner>& corners, std::size_t count) {
  if (corners.size() <= count) return;
  if (count == 0) return corners.clear();
  std::vector<float> responses(corners.size());
  std::transform(corners.begin(), corners.end(), responses.begin(), [](const Corner& one) { return one.response; });
  std::nth_element(responses.begin(), responses.begin() + static_cast<std::ptrdiff_t>(count) - 1, responses.end(),
                   std::greater<float>());
  const float least = responses[count - 1];
  corners.erase(std::remove_if(corners.begin(), corners.end(), [=](const Corner& one) { return one.response < least; }),
                corners.end());
}

// How many of the next bytes, in whole eights of at most `count`, are 0: most pixels are no corners.
inline int zeros_ahead(const std::uint8_t* bytes, int count) {
  int zeros = 0;
  for (std::uint64_t eight; zeros + 8 <= count; zeros += 8) {
    std::memcpy(&eight, bytes + zeros, sizeof eight);
    if (eight != 0) break;
  }
  return zeros;
}

// Corners that have no neighbor of the same score or more, row by row.
inline std::vector<Corner> fast_corners(const Level& image, int edge, std::uint8_t threshold) {
  std::vector<Corner> corners;
  const int width = image.columns - 2 * edge + 2;  // with a neighbor on each side
  const std::int64_t stride = round_up(width, kLanes<std::uint8_t>);
  std::vector<std::uint8_t> lines(3 * stride);
  const auto line = [&](int y) { return lines.data() + (y + 3) % 3 * stride; };
  for (int y = edge - 1; y <= image.rows - edge; ++y) {
    fast_scores(image, y, edge - 1, width, threshold, line(y));
    if (y < edge + 1) continue;
    const std::uint8_t *const above = line(y - 2), *const here = line(y - 1), *const below = line(y);
    for (int i = 1; i < width - 1; ++i) {
      const std::uint8_t score = here[i];
      if (score == 0) {
        i += zeros_ahead(here + i + 1, width - 2 - i);
        continue;
      }
      if (score <= here[i - 1] || score <= here[i + 1]) continue;
      const std::uint8_t most = std::max({above[i - 1], above[i], above[i + 1], below[i - 1], below[i], below[i + 1]});
      if (score > most) corners.push_back({edge - 1 + i, y - 1, static_cast<float>(score)});
    }
  }
  return corners;
}

// Keeps the compiler from joining a product with a sum: the measure is OpenCV's to the bit.
inline float product(float a, float b) {
  float result = a * b;
  asm("" : "+m"(result));
  return result;
}

// Harris's measure over seven by seven pixels, by Sobel's derivatives.
inline float harris(const Level& image, int x, int y) {
  constexpr int kSize = 7, kLanesOfRow = 8;
  constexpr std::int32_t kUsed[kLanesOfRow] = {1, 1, 1, 1, 1, 1, 1, 0};
  constexpr float kScale = 1.0f / (4 * kSize * 255.0f), kShare = 0.04f;
  std::int32_t xx[kLanesOfRow] = {}, yy[kLanesOfRow] = {}, xy[kLanesOfRow] = {};
  for (int r = -kSize / 2; r <= kSize / 2; ++r) {
    const std::uint8_t *const p = image.row(y + r) + x - kSize / 2, *const a = p - image.stride(),
                              *const b = p + image.stride();
    for (int i = 0; i < kLanesOfRow; ++i) {
      const std::int32_t dx = kUsed[i] * ((p[i + 1] - p[i - 1]) * 2 + (a[i + 1] - a[i - 1]) + (b[i + 1] - b[i - 1]));
      const std::int32_t dy = kUsed[i] * ((b[i] - a[i]) * 2 + (b[i - 1] - a[i - 1]) + (b[i + 1] - a[i + 1]));
      xx[i] += dx * dx;
      yy[i] += dy * dy;
      xy[i] += dx * dy;
    }
  }
  std::int32_t sums[3] = {};
  for (int i = 0; i < kLanesOfRow; ++i) {
    sums[0] += xx[i];
    sums[1] += yy[i];
    sums[2] += xy[i];
  }
  const float a = static_cast<float>(sums[0]), b = static_cast<float>(sums[1]), c = static_cast<float>(sums[2]);
  const float trace = a + b, squared = product(kScale, kScale) * kScale * kScale;
  return product(product(a, b) - product(c, c) - product(product(kShare, trace), trace), squared);
}

// At most `count` corners of a level, and those that are as good as the last of them, row by row.
inline std::vector<Corner> corners_of(const Level& image, int edge, std::uint8_t threshold, std::size_t count) {
  std::vector<Corner> corners = fast_corners(image, edge, threshold);
  keep_best(corners, 2 * count);  // more than are wanted, as Harris's measure says better which are corners
  for (Corner& corner : corners) corner.response = harris(image, corner.x, corner.y);
  keep_best(corners, count);
  return corners;
}

}  // namespace orb
}  // namespace spslam
