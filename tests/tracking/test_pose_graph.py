"""The pose graph: its laws, and Open3D's optimiser as the oracle."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.geometry import se3
from taichi_unifusion.tracking.pose_graph import FLOOR, Edge, Prior, optimize, with_floor

EXACT = 1e-9
CONVERGED = 1e-5  # [m, rad] of an optimum that Gauss-Newton walks to
INFORMATION = np.diag(np.array([0.01] * 3 + [0.005] * 3) ** -2)


def twists(seed: int, count: int = 20, turn: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 6)) * np.repeat([1.0, turn], 3)


def circle(count: int) -> np.ndarray:
    """Poses along a circle of 2 m, looking along it."""
    angles = 2 * np.pi * np.arange(count) / count
    return np.array(
        [
            se3.exp(np.array([0, 0, 0, 0, 0, a])) @ se3.exp(np.array([2.0, 0, 0, 0, 0, 0]))
            for a in angles
        ]
    )


def chain(truth: np.ndarray, noise: np.ndarray, closed: bool = True) -> list[Edge]:
    """Measured motions from each pose to the next, the last of them back to the first."""
    return [
        Edge(
            a,
            (a + 1) % len(truth),
            se3.inverse(truth[a]) @ truth[(a + 1) % len(truth)] @ se3.exp(noise[a]),
            INFORMATION,
            robust=a + 1 == len(truth),
            loop=a + 1 == len(truth),
        )
        for a in range(len(truth) - (not closed))
    ]


def integrated(edges: list[Edge], count: int) -> np.ndarray:
    poses = [np.eye(4)]
    for edge in edges[: count - 1]:
        poses.append(poses[-1] @ edge.T_a_b)
    return np.array(poses)


def errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances [m] from the truth, both seen from their first pose."""
    ours, theirs = (se3.inverse(p[0]) @ p for p in (poses, truth))
    return np.linalg.norm(ours[:, :3, 3] - theirs[:, :3, 3], axis=1)


def test_exact_measurements_are_met_exactly():
    truth = circle(12)
    disturbed = truth @ se3.exp(0.1 * twists(4, 12, 0.3))
    disturbed[0] = truth[0]
    found = optimize(disturbed, chain(truth, np.zeros((12, 6))))
    np.testing.assert_allclose(found.T_world_node, truth, atol=CONVERGED)
    np.testing.assert_allclose(found.weights, 1, atol=CONVERGED)


def test_a_loop_takes_back_drift():
    truth = circle(40)
    # a bias too
    noise = 0.3 * twists(5, 40) * np.array([0.01] * 3 + [0.005] * 3) + [0.003, 0, 0, 0, 0, 0.002]
    noise[-1] = 0
    edges = chain(truth, noise)
    drifted = integrated(edges, 40)
    found = optimize(drifted, edges)
    assert errors(drifted, truth).max() > 0.15
    assert np.sqrt((errors(found.T_world_node, truth) ** 2).mean()) < 0.5 * np.sqrt(
        (errors(drifted, truth) ** 2).mean()
    )
    assert found.weights[-1] > 0.5


def test_a_false_loop_is_not_believed():
    truth = circle(40)
    edges = chain(truth, 0.2 * twists(6, 40) * np.array([0.01] * 3 + [0.005] * 3))
    before = optimize(integrated(edges, 40), edges).T_world_node
    # 4 m off
    lie = Edge(
        3, 25, se3.exp(np.array([0.2, 0, 0, 0, 0, 0.1])), INFORMATION, robust=True, loop=True
    )
    found = optimize(integrated(edges, 40), [*edges, lie])
    assert found.weights[-1] < 0.01
    assert errors(found.T_world_node, before).max() < 0.01


def test_priors_hold_the_poses():
    truth = circle(10)
    edges = chain(truth, np.full((10, 6), 0.01), closed=False)
    strong = [Prior(i, pose, 1e8 * np.eye(6)) for i, pose in enumerate(truth)]
    np.testing.assert_allclose(
        optimize(integrated(edges, 10), edges, strong).T_world_node, truth, atol=1e-4
    )


def test_where_the_world_is_does_not_matter():
    truth = circle(12)
    edges = chain(truth, 0.3 * twists(7, 12) * 0.01)
    start, elsewhere = integrated(edges, 12), se3.exp(np.array([3.0, -2, 1, 0.5, 1.0, -0.7]))
    here, there = (optimize(poses, edges).T_world_node for poses in (start, elsewhere @ start))
    np.testing.assert_allclose(elsewhere @ here, there, atol=CONVERGED)


def test_information_is_never_better_than_the_floor():
    for information in (np.zeros((6, 6)), 1e12 * np.eye(6)):
        assert np.linalg.eigvalsh(with_floor(information)).max() <= (FLOOR**-2.0).max() * (1 + 1e-6)


def test_open3d_finds_the_same_optimum():
    o3d = pytest.importorskip("open3d", reason="open3d is not installed")
    graphs, count = o3d.pipelines.registration, 20
    truth = circle(count)
    edges = [
        Edge(e.a, e.b, e.T_a_b, e.information) for e in chain(truth, 0.5 * twists(8, count) * 0.01)
    ]
    start = integrated(edges, count)
    graph = graphs.PoseGraph()
    for pose in start:
        graph.nodes.append(graphs.PoseGraphNode(pose))
    swap = np.r_[3:6, 0:3]  # theirs: rotation first
    for edge in edges:
        graph.edges.append(
            graphs.PoseGraphEdge(
                edge.b, edge.a, edge.T_a_b, edge.information[np.ix_(swap, swap)], False
            )
        )
    option = graphs.GlobalOptimizationOption(reference_node=0)
    graphs.global_optimization(
        graph,
        graphs.GlobalOptimizationLevenbergMarquardt(),
        graphs.GlobalOptimizationConvergenceCriteria(),
        option,
    )
    theirs = np.array([node.pose for node in graph.nodes])
    ours = optimize(start, edges).T_world_node
    assert errors(start, ours).max() > 0.02
    # theirs linearises a residual of other form: equal to first order
    assert errors(ours, theirs).max() < 2e-3
