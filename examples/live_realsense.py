"""Tracks a RealSense camera frame by frame and prints where it is; Ctrl-C writes trajectory and mesh.

python examples/live_realsense.py room.ply                          the camera
python examples/live_realsense.py room.ply --recording room.db3     a recording of its SDK instead
python examples/live_realsense.py room.ply --device cuda            on a GPU
"""

import argparse

import numpy as np
import pyrealsense2 as rs

import spslam


def start(recording):
    """The SDK's pipeline with color and depth, and the camera of the color images."""
    settings, pipeline = rs.config(), rs.pipeline()
    if recording:
        settings.enable_device_from_file(recording, repeat_playback=False)
        player = settings.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback()
        player.set_real_time(False)  # every frame, however long one takes
    else:
        settings.enable_stream(rs.stream.depth, 640, 480, rs.format.z16, 30)
        settings.enable_stream(rs.stream.color, 640, 480, rs.format.rgb8, 30)
    profile = pipeline.start(settings)
    lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    return pipeline, spslam.Camera(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy)


def frames(pipeline):
    """Frames with depth registered to color, until none comes for two seconds."""
    align = rs.align(rs.stream.color)
    while True:
        arrived, images = pipeline.try_wait_for_frames(2000)
        if not arrived:
            return
        images = align.process(images)
        color, depth = images.get_color_frame(), images.get_depth_frame()
        if color and depth:
            # Copies: the SDK uses the memory of its frames again.
            yield spslam.RgbdFrame.from_arrays(
                np.asanyarray(color.get_data()).copy(),
                np.asanyarray(depth.get_data()),
                images.get_timestamp() / 1000,
                depth_scale=1 / depth.get_units(),
            )


def show(pose):
    print("lost" if pose is None else "at ({:.2f}, {:.2f}, {:.2f}) m".format(*pose[:3, 3]), flush=True)


def main():
    parser = argparse.ArgumentParser(description="track a RealSense camera")
    parser.add_argument("mesh", help="file to write, .ply, .obj or .glb")
    parser.add_argument("--recording", help=".bag or .db3 of the SDK")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    args = parser.parse_args()
    pipeline, camera = start(args.recording)
    system = spslam.SlamSystem(spslam.load_config("folder"), camera, device=args.device)
    try:
        for frame in frames(pipeline):
            # The pose is shown before the map is optimized, and of that a small part is made after each frame.
            system.process(frame, on_pose=show, defer_mapping=True)
            system.optimize_map(2)
    except KeyboardInterrupt:
        pass
    finally:
        pipeline.stop()
    system.finish()
    system.trajectory().save_tum("trajectory.txt")
    system.mesh().save(args.mesh)
    print(f"{system}: {args.mesh}, trajectory.txt")


if __name__ == "__main__":
    main()
