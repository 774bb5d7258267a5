"""Segmentation metrics against cases with known answers, brute force and scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.errors import InputError
from taichi_unifusion.evaluation import evaluate_segmentation, transfer_labels
from taichi_unifusion.evaluation.segmentation import score_confusion

NAMES = {1: "wall", 2: "chair", 5: "lamp", 9: "dragon"}


def test_a_case_by_hand():
    truth = [1, 1, 1, 1, 2, 2, 5, -1]
    given = [1, 1, 2, -1, 2, 5, 5, 1]
    result = evaluate_segmentation(given, truth, names=NAMES, unseen=(5, 9))
    wall, chair, lamp = result.classes
    assert (wall.label, wall.name, wall.points, wall.seen) == (1, "wall", 4, True)
    assert (wall.iou, wall.accuracy) == (2 / 4, 2 / 4)
    assert (chair.iou, chair.accuracy) == (1 / 3, 1 / 2)
    assert (lamp.iou, lamp.accuracy, lamp.seen) == (1 / 2, 1, False)
    assert (result.points, result.ignored, result.unlabelled) == (7, 1, 1)
    assert result.overall_accuracy == pytest.approx(4 / 7)
    assert result.mean_iou == pytest.approx(
        (1 / 2 + 1 / 3 + 1 / 2) / 3
    ) and result.mean_accuracy == pytest.approx(2 / 3)
    assert (result.seen.classes, result.seen.mean_iou) == (2, pytest.approx(5 / 12))
    assert (result.unseen.classes, result.unseen.mean_iou, result.unseen.mean_accuracy) == (
        1,
        1 / 2,
        1,
    )


def test_everything_right_and_everything_wrong():
    truth = np.arange(30) % 3
    right, wrong = (
        evaluate_segmentation(truth, truth),
        evaluate_segmentation((truth + 1) % 3, truth),
    )
    assert (
        right.mean_iou,
        right.mean_accuracy,
        right.overall_accuracy,
        right.seen,
        right.unseen,
    ) == (1, 1, 1, None, None)
    assert (wrong.mean_iou, wrong.mean_accuracy, wrong.overall_accuracy) == (0, 0, 0)
    assert [score.name for score in right.classes] == ["0", "1", "2"]


def test_points_to_ignore_play_no_part_whatever_was_given_for_them():
    truth, given = np.array([0, 1, 2, 2, 7]), np.array([0, 1, 2, 1, 1])
    plain = evaluate_segmentation(given[:4], truth[:4])
    for ignored in (
        evaluate_segmentation(given, truth, ignore=(7,)),
        evaluate_segmentation(given, truth, names={0: "a", 1: "b", 2: "c"}),
    ):
        assert ignored.ignored == 1 and ignored.mean_iou == plain.mean_iou and ignored.points == 4


def test_labels_of_no_true_class_are_missed_points_and_no_classes():
    result = evaluate_segmentation([0, 8, -1, -3], [0, 0, 0, 0])
    assert (
        result.mean_iou == result.mean_accuracy == 0.25
        and len(result.classes) == 1
        and result.unlabelled == 1
    )


def test_names_of_labels_do_not_matter():
    rng = np.random.default_rng(0)
    truth, given = rng.integers(0, 6, 500), rng.integers(0, 6, 500)
    new = np.array([40, 3, 77, 0, 12, 5])
    here, there = evaluate_segmentation(given, truth), evaluate_segmentation(new[given], new[truth])
    assert (
        there.mean_iou == pytest.approx(here.mean_iou)
        and there.overall_accuracy == here.overall_accuracy
    )
    assert [s.iou for s in there.classes] == [here.classes[i].iou for i in np.argsort(new)]


def test_numbers_are_those_of_counting_one_by_one_and_of_scikit_learn():
    rng = np.random.default_rng(1)
    truth, given = rng.integers(0, 5, 2000), rng.integers(-1, 7, 2000)
    result = evaluate_segmentation(given, truth)
    for score in result.classes:
        pairs = [(t == score.label, g == score.label) for t, g in zip(truth, given, strict=True)]
        both, either = sum(t and g for t, g in pairs), sum(t or g for t, g in pairs)
        assert score.iou == both / either and score.accuracy == both / sum(t for t, _ in pairs)
    sklearn = pytest.importorskip(
        "sklearn.metrics", reason="scikit-learn is not installed: pip install scikit-learn"
    )
    assert result.mean_iou == pytest.approx(
        sklearn.jaccard_score(truth, given, labels=range(5), average="macro")
    )
    assert result.mean_accuracy == pytest.approx(
        sklearn.recall_score(truth, given, labels=range(5), average="macro")
    )
    assert result.overall_accuracy == pytest.approx(sklearn.accuracy_score(truth, given))


# --- Transfer -------------------------------------------------------------------------------------------------------


def test_labels_go_to_the_nearest_within_reach():
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    targets = [
        (0.04, 0, 0),
        (0.97, 0.02, 0),
        (0, 0.95, 0),
        (0.6, 0.5, 0),
        (0, 0, 0.0999),
        (0, 0, 0.1001),
    ]
    assert transfer_labels(points, [3, 4, 5], targets).tolist() == [3, 4, 5, -1, 3, -1]
    assert transfer_labels(points, [3, 4, 5], targets, max_distance=1.0)[3] == 4


def test_transfer_to_the_same_points_changes_nothing():
    points, labels = np.random.default_rng(0).uniform(size=(200, 3)), np.arange(200)
    assert (transfer_labels(points, labels, points) == labels).all()


def test_labels_may_come_as_a_mesh_carries_them():
    column = np.array([[1.0], [2.0]], np.float32)
    assert evaluate_segmentation(column, [1, 2]).mean_iou == 1


# --- Bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("predicted", "truth", "options", "told"),
    [
        ([1, 2], [1, 2, 3], {}, "2 predicted labels but 3 true ones"),
        ([], [], {}, r"predicted labels must be \(N,\) whole numbers"),
        ([1.5], [1], {}, "predicted labels hold numbers that are not whole"),
        ([1], [np.nan], {}, "true labels hold numbers that are not whole"),
        ([1e300], [1], {}, "not whole"),
        (["chair"], [1], {}, "whole numbers"),
        ([[1, 2]], [1], {}, "whole numbers"),
        ([1, 1], [-1, -1], {}, "no point is left of 2"),
        ([1], [1], {"names": {}}, "no point is left"),
        ([1], [1], {"names": NAMES, "unseen": (4,)}, "unseen class 4 is not among the names"),
        (np.arange(20_000), np.arange(20_000), {}, "20000 different true labels"),
    ],
)
def test_bad_labels_are_told_in_one_sentence(predicted, truth, options, told):
    with pytest.raises(InputError, match=told):
        evaluate_segmentation(predicted, truth, **options)


@pytest.mark.parametrize(
    ("points", "labels", "options", "told"),
    [
        ([(0, 0, 0)], [1, 2], {}, "1 points but 2 labels"),
        ([(0, 0, np.nan)], [1], {}, "finite"),
        (np.empty((0, 3)), [1], {}, "at least one"),
        ([(0, 0, 0)], [1], {"max_distance": 0.0}, "above 0 m"),
        ([(0, 0, 0)], [1], {"max_distance": float("nan")}, "above 0 m"),
    ],
)
def test_bad_points_are_told_in_one_sentence(points, labels, options, told):
    with pytest.raises(InputError, match=told):
        transfer_labels(points, labels, [(0, 0, 0)], **options)


def test_added_counts_of_scenes_score_as_all_their_points_together():
    """Also where a class is given in a scene that has none of it."""
    rng = np.random.default_rng(3)
    truth, given = rng.choice([1, 2, 5, 7], 300), rng.choice([-1, 1, 2, 5, 9], 300)
    truth[:100] = rng.choice(
        [1, 2], 100
    )  # a scene without lamps, some of whose points are called so
    together = evaluate_segmentation(given, truth, names=NAMES, unseen=(5,))
    scenes = [
        evaluate_segmentation(given[part], truth[part], names=NAMES, unseen=(5,))
        for part in (slice(0, 100), slice(100, 300))
    ]
    assert {scene.labels for scene in scenes} == {(1, 2, 5, 9)}
    counts = np.sum([scene.confusion for scene in scenes], axis=0)
    added = score_confusion(
        counts,
        np.array(scenes[0].labels),
        names=NAMES,
        unseen=(5,),
        ignored=sum(scene.ignored for scene in scenes),
        unlabelled=sum(scene.unlabelled for scene in scenes),
    )
    assert added == together
    with pytest.raises(InputError, match="no point to score"):
        score_confusion(np.zeros((4, 5), int), np.array([1, 2, 5, 9]))
