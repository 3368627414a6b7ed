#include "cuda/launch_graph.h"
#include "spslam/launch_graph.h"

namespace spslam {

LaunchGraph* make_launch_graph() {
  return new LaunchGraph;
}

void free_launch_graph(LaunchGraph* graph) {
  delete graph;
}

int launch_graph_builds(const LaunchGraph* graph) {
  return graph->builds();
}

}  // namespace spslam
