// The levels of an image that features are looked for on, to the bit those of OpenCV.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core/macros.h"

namespace spslam {
namespace orb {

constexpr int kLevels = 8;
constexpr double kLevelScale = 1.2f;  // OpenCV takes it in single precision
// Pixels around a level that mirror it: the pattern of a descriptor reaches so far, turned, from a corner at the edge.
constexpr int kMargin = 23;

// To the nearest whole number, to the even one from the middle.
inline int rounded(double value) {
  return static_cast<int>(std::nearbyint(value));
}

// An image with a margin, in memory of its owner.
struct Level {
  int rows, columns;
  std::uint8_t* pixels;  // with the margin

  std::int64_t stride() const { return columns + 2 * kMargin; }
  std::int64_t bytes() const { return (rows + 2 * kMargin) * stride(); }
  std::uint8_t* row(int y) const { return pixels + (y + kMargin) * stride() + kMargin; }

  // Makes the margin what lies on the other side of the outermost pixels.
  void mirror_margin() const {
    for (int y = 0; y < rows; ++y) {
      std::uint8_t* const line = row(y);
      for (int k = 1; k <= kMargin; ++k) {
        line[-k] = line[k];
        line[columns - 1 + k] = line[columns - 1 - k];
      }
    }
    for (int k = 1; k <= kMargin; ++k) {
      std::memcpy(row(-k) - kMargin, row(k) - kMargin, stride());
      std::memcpy(row(rows - 1 + k) - kMargin, row(rows - 1 - k) - kMargin, stride());
    }
  }
};

// Which two pixels a pixel of a smaller image lies between, and the weight of the second in 1/256.
struct Between {
  std::vector<std::int32_t> first, second;
  std::vector<std::uint32_t> weight;

  Between(int from, int to) : first(to), second(to), weight(to) {
    const double scale = 1.0 / (static_cast<double>(to) / from);
    for (int i = 0; i < to; ++i) {
      const double place = scale * (i + 0.5) - 0.5;
      const int before = static_cast<int>(std::floor(place));
      const bool inside = before >= 0 && before < from - 1;
      first[i] = std::clamp(before, 0, from - 1);
      second[i] = inside ? before + 1 : first[i];
      weight[i] = inside ? static_cast<std::uint32_t>(rounded((place - before) * 256)) : 0;
    }
  }
};

// Linear interpolation, as OpenCV's INTER_LINEAR_EXACT.
inline void resize(const Level& from, const Level& to) {
  const Between columns(from.columns, to.columns), rows(from.rows, to.rows);
  const std::int32_t* const first = columns.first.data();
  const std::uint32_t* const weight = columns.weight.data();
  std::vector<std::uint32_t> pairs(from.columns);  // a pixel and the next one: vectors are gathered of words only
  std::vector<std::uint16_t> lines(2 * to.columns);
  int held[2] = {-1, -1};
  for (int y = 0; y < to.rows; ++y) {
    const int wanted[2] = {rows.first[y], rows.second[y]};
    for (int k = 0; k < 2; ++k) {
      std::uint16_t* const line = lines.data() + (wanted[k] % 2) * to.columns;
      if (held[wanted[k] % 2] == wanted[k]) continue;
      held[wanted[k] % 2] = wanted[k];
      const std::uint8_t* const source = from.row(wanted[k]);
      std::uint32_t* const pair = pairs.data();
      SPS_SIMD for (int x = 0; x < from.columns; ++x) {
        pair[x] = source[x] | static_cast<std::uint32_t>(source[x + 1]) << 16;
      }
      SPS_SIMD for (int x = 0; x < to.columns; ++x) {
        const std::uint32_t both = pair[first[x]];
        line[x] = static_cast<std::uint16_t>((256 - weight[x]) * (both & 0xFFFF) + weight[x] * (both >> 16));
      }
    }
    const std::uint16_t* const upper = lines.data() + (wanted[0] % 2) * to.columns;
    const std::uint16_t* const lower = lines.data() + (wanted[1] % 2) * to.columns;
    const std::uint32_t below = rows.weight[y], above = 256 - below;
    std::uint8_t* const out = to.row(y);
    SPS_SIMD for (int x = 0; x < to.columns; ++x) {
      out[x] = static_cast<std::uint8_t>((above * upper[x] + below * lower[x] + (1u << 15)) >> 16);
    }
  }
}

// By a Gaussian of 7 pixels and a deviation of 2; the margin stays as it is. `lines` are room for (rows + 6) rows.
inline void blur(const Level& image, const Level& out, float* lines) {
  constexpr float kWeights[4] = {0.21610594f, 0.19071282f, 0.13107488f, 0.07015933f};  // from the middle
  const int rows = image.rows, columns = image.columns;
  std::memcpy(out.pixels, image.pixels, image.bytes());
  for (int y = -3; y < rows + 3; ++y) {
    const std::uint8_t* const in = image.row(y);
    float* const line = lines + (y + 3) * std::int64_t{columns};
    for (int x = 0; x < columns; ++x) {
      line[x] = kWeights[0] * static_cast<float>(in[x]) + kWeights[1] * static_cast<float>(in[x - 1] + in[x + 1]) +
                kWeights[2] * static_cast<float>(in[x - 2] + in[x + 2]) +
                kWeights[3] * static_cast<float>(in[x - 3] + in[x + 3]);
    }
  }
  for (int y = 0; y < rows; ++y) {
    const float* line[7];
    for (int k = 0; k < 7; ++k) line[k] = lines + (y + k) * std::int64_t{columns};
    std::uint8_t* const to = out.row(y);
    for (int x = 0; x < columns; ++x) {
      const float sum = kWeights[0] * line[3][x] + kWeights[1] * (line[2][x] + line[4][x]) +
                        kWeights[2] * (line[1][x] + line[5][x]) + kWeights[3] * (line[0][x] + line[6][x]);
      to[x] = static_cast<std::uint8_t>(static_cast<std::int32_t>(sum + 0.5f));
    }
  }
}

}  // namespace orb
}  // namespace spslam
