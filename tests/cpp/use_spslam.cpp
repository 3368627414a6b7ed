// Calls a kernel on several threads, through headers as they are installed.
#include <spslam/core/parallel.h>
#include <spslam/interpolation.h>
#include <spslam/version.h>

#include <cstdio>
#include <string>
#include <vector>

int main() {
  const std::string version = std::to_string(SPSLAM_VERSION_MAJOR) + "." + std::to_string(SPSLAM_VERSION_MINOR) + "." +
                              std::to_string(SPSLAM_VERSION_PATCH);
  if (version != SPSLAM_VERSION) return 1;
  spslam::set_num_threads(2);
  constexpr std::int64_t kPoints = 100'000;
  const std::vector<float> embeddings{0, 1, 2, 3, 4, 5, 6, 7}, local(3 * kPoints, 0.5f);
  std::vector<std::int32_t> corners(8 * kPoints);
  for (std::int64_t i = 0; i < 8 * kPoints; ++i) corners[i] = static_cast<std::int32_t>(i % 8);
  std::vector<float> out(kPoints);
  spslam::trilinear_interpolate(spslam::Cpu{}, embeddings.data(), 8, 1, corners.data(), local.data(), kPoints,
                                out.data());
  for (const float value : out) {
    if (value != 3.5f) return 2;
  }
  std::printf("spslam %s\n", SPSLAM_VERSION);
  return 0;
}
