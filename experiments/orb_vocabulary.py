"""A vocabulary for the ORB-SLAM3 baseline where the official one cannot be downloaded, from frames of generated places.

python -m experiments.orb_vocabulary --output ORBvoc.txt
export PYORBSLAM3_VOCAB=$PWD/ORBvoc.txt

A tree of ORB descriptors in DBoW2's text format (D. Galvez-Lopez and J. D. Tardos, *Bags of Binary Words for Fast Place
Recognition in Image Sequences*, IEEE Transactions on Robotics 28, 2012): 10 branches, 6 levels, by k-majority with
k-means++ seeding; words are weighted by their inverse document frequency. The official vocabulary was trained on
photographs; say so where a figure comes from this one. The seeds of the places are not those that are benchmarked.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from experiments.arguments import make_parser
from spslam.datasets.places import PlacesDataset
from spslam.datasets.places.registry import PLACES
from spslam.io import atomic_write

BRANCHES, LEVELS = 10, 6
# ORB-SLAM3 groups features by their node on level 2, so no word may be above it.
FIRST_WORD_LEVEL, LARGEST_WORD = 3, 12
ITERATIONS, CLUSTERED = 8, 20_000
FEATURES, PYRAMID_SCALE, PYRAMID_LEVELS, FAST_THRESHOLD = 1000, 1.2, 8, 12
FIRST_SEED, FRAME_STEP = 1000, 45


@dataclass(frozen=True)
class Node:
    """A node of the vocabulary: number of its parent (0 is the root), descriptor in bits, weight (None for no word)."""

    parent: int
    bits: np.ndarray
    weight: float | None


def place_images(seeds: int, frames: int) -> Iterator[np.ndarray]:
    """Gray images, uint8 [H, W], of all places."""
    for place in PLACES:
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            data = PlacesDataset(place, "walking", "structured_light", FRAME_STEP * frames, seed)
            for index in range(0, len(data), FRAME_STEP):
                yield cv2.cvtColor(data[index].color, cv2.COLOR_RGB2GRAY)


def descriptors(images: Iterator[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """ORB descriptors of images: float32 [N, 256] of -1 and 1, and int64 [N], the number of each one's image."""
    orb = cv2.ORB_create(FEATURES, PYRAMID_SCALE, PYRAMID_LEVELS, fastThreshold=FAST_THRESHOLD)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    found = [rows for rows in found if rows is not None]
    numbers = np.repeat(np.arange(len(found)), [len(rows) for rows in found])
    return np.unpackbits(np.concatenate(found), axis=1).astype(np.float32) * 2 - 1, numbers


def train(bits: np.ndarray, images: np.ndarray, generator: np.random.Generator) -> Iterator[Node]:
    """The nodes of the tree, parents before children.

    Args:
        bits: float32 [N, 256], -1 or 1.
        images: int64 [N], number of the image that each row is from.
        generator: of the random draws.
    """
    documents = len(np.unique(images))
    open_nodes, last = [(np.arange(len(bits)), 0, 1)], 0
    while open_nodes:
        rows, parent, level = open_nodes.pop()
        centers = cluster(bits[rows], generator)
        nearest = (bits[rows] @ centers.T).argmax(1)
        for number in np.unique(nearest):
            members = rows[nearest == number]
            is_word = level == LEVELS or (level >= FIRST_WORD_LEVEL and len(members) <= LARGEST_WORD)
            weight = float(np.log(documents / len(np.unique(images[members])))) if is_word else None
            yield Node(parent, centers[number], weight)
            last += 1
            if not is_word:
                open_nodes.append((members, last, level + 1))


def cluster(bits: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Centers of at most `BRANCHES` clusters by k-majority, float32 [K, 256] of -1 and 1."""
    if len(bits) > CLUSTERED:
        bits = bits[generator.choice(len(bits), CLUSTERED, replace=False)]
    centers = seeds(bits, generator)
    before = None
    for _ in range(ITERATIONS):
        nearest = (bits @ centers.T).argmax(1)
        if before is not None and np.array_equal(nearest, before):
            break
        for number in np.unique(nearest):
            centers[number] = np.where(bits[nearest == number].sum(0) >= 0, 1, -1)
        before = nearest
    return centers


def seeds(bits: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """First centers by k-means++ (Arthur and Vassilvitskii 2007), no two alike."""
    chosen = [bits[generator.integers(len(bits))]]
    # For -1 and 1 the squared Euclidean distance is four times the Hamming distance.
    distance = bits.shape[1] - bits @ chosen[0]
    while len(chosen) < BRANCHES and distance.any():
        chosen.append(bits[generator.choice(len(bits), p=distance / distance.sum(dtype=np.float64))])
        distance = np.minimum(distance, bits.shape[1] - bits @ chosen[-1])
    return np.array(chosen)


def to_text(nodes: list[Node]) -> str:
    """DBoW2's text format: branches, levels, L1 scoring, TF-IDF weighting; then `parent is_word 32 bytes weight`."""
    lines = [f"{BRANCHES} {LEVELS} 0 0"]
    for node in nodes:
        numbers = " ".join(map(str, np.packbits(node.bits > 0)))
        lines.append(f"{node.parent} {int(node.weight is not None)} {numbers} {node.weight or 0:.6g}")
    # The library takes an empty last line for a node.
    return "\n".join(lines)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--output", type=Path, required=True, help="file of the vocabulary")
    parser.add_argument("--seeds", type=int, default=3, help="number of each kind of place")
    parser.add_argument("--frames", type=int, default=20, help="images of each place")
    args = parser.parse_args()
    bits, images = descriptors(place_images(args.seeds, args.frames))
    nodes = list(train(bits, images, np.random.default_rng(0)))
    atomic_write(args.output, to_text(nodes))
    words = sum(node.weight is not None for node in nodes)
    print(f"{args.output}: {words} words in {len(nodes)} nodes, of {len(bits)} descriptors")


if __name__ == "__main__":
    main()
