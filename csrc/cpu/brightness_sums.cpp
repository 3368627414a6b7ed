#include "spslam/brightness_sums.h"

#include <algorithm>

#include "core/parallel.h"
#include "kernels/brightness_sums.h"

namespace spslam {

template <>
std::int64_t brightness_workspace_size<Cpu>(Cpu, const SeenPixels& seen, std::int64_t num_rows) {
  return num_rows * cells_of_frame(seen) * kBrightnessSums * static_cast<std::int64_t>(sizeof(std::int64_t));
}

template <>
void sum_brightness<Cpu>(Cpu, const SeenPixels& seen, const std::int64_t* rows, std::int64_t num_rows,
                         const ShownImages& shown, const float* pose, void* workspace, double* sums) {
  std::int64_t* cells = static_cast<std::int64_t*>(workspace);
  const std::int64_t num_cells = cells_of_frame(seen);
  const Pose<double> own = load_frame_pose(pose);
  std::fill_n(cells, num_rows * num_cells * kBrightnessSums, std::int64_t{0});
  parallel_for(num_rows, 1, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      if (!is_row(seen, rows[i])) continue;
      const Pose<double> from = load_frame_pose(seen.poses + kPoseSize * rows[i]);
      const std::int32_t* records = seen.records + kPixelWords * seen.num_records * rows[i];
      for (std::int64_t p = 0; p < seen.num_points; ++p) {
        const PointBrightness point = compared_brightness(seen, records + kPixelWords * p, from, shown, own);
        if (point.cell < 0) continue;
        std::int64_t* cell = cells + kBrightnessSums * (num_cells * i + point.cell);
        add_brightness(point, [cell](int which, std::int64_t value) { cell[which] += value; });
      }
    }
  });
  finish_brightness(cells, num_rows * num_cells, sums);
}

}  // namespace spslam
