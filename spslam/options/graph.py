"""Options of the keyframe graph."""

from __future__ import annotations

from spslam.options.needs import is_, need
from spslam.options.section import Section, option

_GRAPH = need(is_("graph.enabled", True))


class GraphOptions(Section):
    """The keyframe graph, which makes poses and map globally consistent (docs/graph.md)."""

    enabled: bool = option(
        "register keyframes with one another, close loops, and make the map again where poses moved",
        needs=(need(is_("prior.enabled", True)),),
    )
    loops: bool = option(
        "close loops that image features find; without, only keyframes that share surface where they are known are "
        "registered",
        needs=(_GRAPH,),
    )
    every: int = option("frames between two solutions of the graph", "frames", needs=(_GRAPH,), ge=1)
    max_translation_m: float = option(
        "distance from the last keyframe at which a frame becomes one; less where the surface is near: 0.15 of its "
        "median depth",
        "m",
        needs=(_GRAPH,),
        gt=0,
    )
    max_rotation_deg: float = option(
        "angle from the last keyframe at which a frame becomes one", "degrees", needs=(_GRAPH,), gt=0, le=180
    )
    new_map_after_s: float | None = option(
        "how long the camera is lost before a map of its own begins, which joins the other when the camera is known "
        "there again; null begins none",
        "s",
        needs=(_GRAPH,),
        ge=0,
    )
    min_change_m: float = option(
        "the map is made again where the graph moves a keyframe, or what it sees 2 m ahead, by more",
        "m",
        needs=(_GRAPH,),
        gt=0,
    )
