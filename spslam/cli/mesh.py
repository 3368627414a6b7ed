"""`spslam mesh`: makes a mesh of a finished run, fused from its frames or extracted from its map."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spslam.cli.arguments import add_device, add_run_folder, mesh_resolution, positive_meters, require_run_file
from spslam.config import Config, load_config
from spslam.errors import DatasetError, OutputError
from spslam.io import writing
from spslam.run.standby import end_standby, launch_image_readers
from spslam.run_folder import MESH_FORMATS, TEXTURED_FORMATS, RunFolder, is_merged

if TYPE_CHECKING:
    import torch

    from spslam.datasets.base import RgbdDataset
    from spslam.evaluation.run_data import RunData
    from spslam.evaluation.run_output import RunOutput
    from spslam.meshing import TriangleMesh
    from spslam.options import MeshOptions
    from spslam.run.mesh import EarlierFrames, TextureWish

SOURCES = ("tsdf", "neural")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_folder(parser)
    parser.add_argument(
        "--source",
        choices=SOURCES,
        help="tsdf reads the frames again and fuses them, neural extracts the map; as the run itself if not given",
    )
    parser.add_argument(
        "--resolution",
        metavar="M",
        type=mesh_resolution,
        help="edge length of a voxel or marching-cubes cell in meters; the run's mesh.resolution_m if not given",
    )
    parser.add_argument(
        "--subdivisions",
        metavar="N",
        type=int,
        choices=range(4),
        help="how many times edges are divided for finer colors; the run's mesh.color_subdivisions if not given",
    )
    parser.add_argument(
        "--format", choices=MESH_FORMATS, help="file format; ply if not given, glb with --texture, which ply can't have"
    )
    parser.add_argument(
        "--texture",
        action="store_true",
        help="bake the frames' colors into a texture, finer than colors of vertices; reads the frames again",
    )
    parser.add_argument(
        "--texel",
        metavar="M",
        type=positive_meters,
        help="edge length of a texel of --texture in meters; as finely as the frames saw the surface if not given",
    )
    add_device(parser)


def execute(args: argparse.Namespace) -> None:
    file_format = _file_format(args)
    folder = RunFolder(args.output)
    require_run_file(folder.map)
    config = load_config(require_run_file(folder.config))
    if args.texture or (args.source or config.mesh.source) == "tsdf":
        launch_image_readers(config, args.device or config.device)  # loading torch takes seconds

    from spslam.run.device import explained_failures, resolve_device

    try:
        device = resolve_device(args.device or config.device)
        with explained_failures(device, "choose a larger --resolution"):
            if is_merged(folder):
                _execute_merged(args, folder, config, file_format, device)
            else:
                _execute_run(args, folder, config, file_format, device)
    finally:
        end_standby()


def _execute_run(
    args: argparse.Namespace, folder: RunFolder, config: Config, file_format: str, device: torch.device
) -> None:
    from spslam.evaluation.run_output import RunOutput
    from spslam.run.mesh import MeshJob, measured_noise, measured_readout_s, write_mesh
    from spslam.scene import Scene

    run = RunOutput.read(args.output)
    options = _mesh_options(args, config.mesh, "neural" if _is_live(run) else config.mesh.source)
    dataset = _open_again(run, config, args.texture) if options.source == "tsdf" or args.texture else None
    earlier = _earlier(folder, dataset is not None) if "map" in run.metrics else []
    scene, of_sensor = Scene.load(folder.map, device), (measured_noise(run.metrics), measured_readout_s(run.metrics))
    job = MeshJob(scene, run.trajectory, run.camera, options, *of_sensor, earlier, _texture(args), needs_frames=True)
    path = folder.mesh_as(file_format)
    mesh, figures = _replace_mesh(path, lambda place: write_mesh(place, job, dataset))
    _print_mesh(path, mesh, figures)
    for line in () if dataset is None else dataset.unreadable_in_words():
        print(f"! {line}")
    if path == folder.mesh:
        _replace_figures(run, figures)


def _replace_mesh(path: Path, write: Callable[[Path], Any]) -> Any:
    """What `write` returns, the mesh first, when it has written it.

    What was made before stays until then, and where there is no surface.

    Raises:
        OutputError: the mesh has no surface, or can't be written.
    """
    from spslam.run.mesh import no_surface

    if path.suffix != ".ply":  # no other format takes a mesh without faces: `write` refuses to write it
        results = write(path)
        _remove_old_textures(path, results[1])
        return results
    # As `atomic_write` names them, so that what a killed command leaves is known.
    place = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        results = write(place)
        if not len(results[0].faces):
            raise OutputError(no_surface(path, results[1]["mesh_resolution_m"]))
        with writing(path):
            os.replace(place, path)
    except OutputError as error:
        raise OutputError(str(error).replace(str(place), str(path))) from None
    finally:
        place.unlink(missing_ok=True)
    return results


def _remove_old_textures(path: Path, figures: dict[str, Any]) -> None:
    """Removes the materials and images of an OBJ before this one, which it does not name."""
    if path.suffix != ".obj":
        return
    pages = figures["texture_size"][0] if "texture_size" in figures else 0
    named = {"mesh.mtl", *(f"mesh-{page}.png" for page in range(pages))} if pages else set()
    for old in RunFolder(path.parent).texture_files():
        if old.name not in named:
            with writing(old):
                old.unlink()


def _replace_figures(run: RunOutput, figures: dict[str, Any]) -> None:
    """Writes metrics and report of a run with the figures of its new mesh, and without those of the mesh before."""
    from spslam.evaluation.finished_run import MESH_KEYS, SURFACE_KEYS, VIEW_KEYS, add_metrics
    from spslam.evaluation.html_report import write_report

    add_metrics(run, figures, SURFACE_KEYS | VIEW_KEYS | MESH_KEYS)
    if run.folder.report.is_file():
        write_report(run.folder.path)
    groups = (("--gt-mesh PLY", SURFACE_KEYS), ("--views", VIEW_KEYS))
    asked = [words for words, keys in groups if keys & run.metrics.keys()]
    if asked:
        again = f"spslam eval {run.folder.path} {' '.join(asked)}"
        print(f"! the figures of the mesh before were removed; `{again}` measures this one")


def _mesh_options(args: argparse.Namespace, options: MeshOptions, source: str) -> MeshOptions:
    """The options of a run's mesh with what was asked for in their place.

    Raises:
        OutputError: subdivisions were asked for that the mesh asked for has not.
    """
    source = args.source or source
    if args.subdivisions is not None and (source == "neural" or args.texture):
        other = "--texture has finer colors" if args.texture else "the mesh of the map alone has no colors of frames"
        raise OutputError(f"--subdivisions is of vertices with colors of frames, and {other}")
    changes = {"source": source, "resolution_m": args.resolution or options.resolution_m}
    if args.subdivisions is not None:
        changes["color_subdivisions"] = args.subdivisions
    return options.model_copy(update=changes)


def _file_format(args: argparse.Namespace) -> str:
    """The format asked for, or the usual one.

    Raises:
        OutputError: a format without textures was asked for with one, or a size of texels without a texture.
    """
    if args.texel and not args.texture:
        raise OutputError("--texel is the size of what --texture makes, and needs it")
    if not args.texture:
        return args.format or "ply"
    if args.format and args.format not in TEXTURED_FORMATS:
        raise OutputError(
            f"--format {args.format} can't have a texture: --texture needs {' or '.join(TEXTURED_FORMATS)}"
        )
    return args.format or TEXTURED_FORMATS[0]


def _texture(args: argparse.Namespace) -> TextureWish | None:
    """What `--texture` and `--texel` ask for; raises SpslamError for a size of texels that no texture has."""
    from spslam.meshing.texture.texturing import check_texel
    from spslam.run.mesh import TextureWish

    if args.texel is not None:
        check_texel(args.texel)
    return TextureWish(args.texel) if args.texture else None


def _execute_merged(
    args: argparse.Namespace, folder: RunFolder, config: Config, file_format: str, device: torch.device
) -> None:
    from spslam.run.recordings import write_map_mesh
    from spslam.scene import Scene
    from spslam.slam.graph.archive import KeyframeArchive

    archive = KeyframeArchive.load(require_run_file(folder.keyframes))
    path, options = folder.mesh_as(file_format), _mesh_options(args, config.mesh, config.mesh.source)
    scene, texture = Scene.load(folder.map, device), _texture(args)
    mesh, figures, missing = _replace_mesh(path, lambda place: write_map_mesh(place, scene, archive, options, texture))
    for line in missing:
        print(f"! {line}")
    _print_mesh(path, mesh, figures)
    if path == folder.mesh and folder.metrics.is_file():
        _replace_merged_figures(folder, figures, missing)


def _replace_merged_figures(folder: RunFolder, figures: dict[str, Any], missing: list[str]) -> None:
    """Writes metrics of a merged map with the figures of its new mesh; its warnings are of the mesh alone."""
    from spslam.evaluation.finished_run import MESH_KEYS, write_metrics
    from spslam.reading import MAX_JSON_BYTES, parse_json, read_text

    known = parse_json(read_text(folder.metrics, MAX_JSON_BYTES, OutputError), str(folder.metrics), OutputError)
    warnings = {"warnings": missing} if missing else {}
    write_metrics(folder, known, {**figures, **warnings}, MESH_KEYS | {"warnings"})


def _print_mesh(path: Path, mesh: TriangleMesh, figures: dict[str, Any]) -> None:
    size = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    made_of = f", {figures['mesh_mb']:.0f} MB of voxels" if "mesh_mb" in figures else ""
    made_at = f"{figures['mesh_source']} at {figures['mesh_resolution_m']:g} m"
    textured = ""
    if "texel_m" in figures:
        pages, width, height = figures["texture_size"]
        textured = f"; texels of {1e3 * figures['texel_m']:.1f} mm, {pages} x {width}x{height} px"
        if figures["texel_m"] > figures["wanted_texel_m"]:
            wanted = f"{1e3 * figures['wanted_texel_m']:.2g} mm"
            print(f"! texels of {wanted} would need more than {figures['most_pages']} pages; larger ones are taken")
    print(f"{path}: {size}; {made_at}{made_of}{textured}, {figures['mesh_s']:.1f} s")


def _is_live(run: RunOutput) -> bool:
    """Whether it was a live run, whose own mesh is of the map alone: its frames came once."""
    return "received_frames" in run.metrics


def _earlier(folder: RunFolder, are_read: bool) -> list[EarlierFrames]:
    """The recordings that the map of a run with `--map` is of beside the run's; says which can't be read again.

    Args:
        folder: of the run.
        are_read: whether their frames are wanted, not their trajectories alone.
    """
    from spslam.run.mesh import EarlierFrames
    from spslam.run.recordings import read_again
    from spslam.slam.graph.archive import KeyframeArchive

    archive = KeyframeArchive.load(require_run_file(folder.keyframes))
    if not are_read:
        return [EarlierFrames(each.trajectory, None) for each in archive.recordings[:-1]]
    earlier, missing = read_again(archive, archive.recordings[:-1])
    for line in missing:
        print(f"! {line}")
    return earlier


def _open_again(run: RunOutput, config: Config, for_texture: bool) -> RunData:
    """The data of a run; says what is missing of it."""
    from spslam.evaluation.run_data import data_of_run

    dataset, missing = data_of_run(run, _opened_again(run, config, for_texture))
    for line in missing:
        print(f"! {line}")
    return dataset


def _opened_again(run: RunOutput, config: Config, for_texture: bool) -> RgbdDataset:
    from spslam.datasets import open_dataset

    try:
        return open_dataset(config.dataset)
    except DatasetError as error:
        if for_texture:
            raise OutputError(
                f"{run.folder.path}: a texture is made of the run's frames, which can't be read again ({error})"
            ) from None
        if not _is_live(run):
            raise OutputError(
                f"{run.folder.path}: the run's frames can't be read again ({error}): put them back, or use --source "
                "neural, which needs none"
            ) from None
        raise OutputError(
            f"{run.folder.path}: the frames of a live run can't be read again; --source neural needs none ({error})"
        ) from None
