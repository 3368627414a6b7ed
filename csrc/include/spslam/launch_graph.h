// A CUDA graph that a caller keeps from call to call.
#pragma once

namespace spslam {

class LaunchGraph;

LaunchGraph* make_launch_graph();
// Work under way is finished all the same.
void free_launch_graph(LaunchGraph* graph);
// How often it was built anew: at first, and when the shape of a call changed.
int launch_graph_builds(const LaunchGraph* graph);

}  // namespace spslam
