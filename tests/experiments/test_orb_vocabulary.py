"""A vocabulary for ORB-SLAM3."""

import numpy as np

from experiments.orb_vocabulary import FIRST_WORD_LEVEL, LEVELS, descriptors, to_text, train


def nodes_of_noise():
    images = (np.random.default_rng(seed).integers(0, 255, (120, 160), dtype=np.uint8) for seed in range(2))
    bits, numbers = descriptors(images)
    assert set(numbers) == {0, 1}
    return bits, list(train(bits, numbers, np.random.default_rng(0)))


def levels(nodes):
    found = [0]
    for node in nodes:
        found.append(found[node.parent] + 1)
    return found[1:]


def test_tree_has_words_as_leaves():
    bits, nodes = nodes_of_noise()
    assert all(node.parent <= number for number, node in enumerate(nodes))
    parents = {node.parent for node in nodes}
    for number, (node, level) in enumerate(zip(nodes, levels(nodes), strict=True), 1):
        assert (node.weight is not None) == (number not in parents)
        assert FIRST_WORD_LEVEL <= level <= LEVELS or node.weight is None
        assert node.weight is None or node.weight >= 0
    assert set(np.unique([node.bits for node in nodes])) == {-1, 1}


def test_alike_descriptors_make_one_word():
    nodes = list(train(np.ones((50, 256), np.float32), np.zeros(50, np.int64), np.random.default_rng(0)))
    assert levels(nodes) == list(range(1, LEVELS + 1))
    assert [node.weight for node in nodes] == [None] * (LEVELS - 1) + [0.0]


def test_text_is_the_librarys_format():
    _, nodes = nodes_of_noise()
    first, *rows = to_text(nodes).split("\n")
    assert first == "10 6 0 0"
    assert len(rows) == len(nodes)
    words = [row.split() for row in rows]
    assert {len(row) for row in words} == {35}
    np.testing.assert_array_equal(np.packbits(nodes[3].bits > 0), [int(word) for word in words[3][2:34]])
