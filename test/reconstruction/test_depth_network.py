"""Depth by a network: tiny ones built here go through the real loading code; what they see is made metric."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from training_views import unknown

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction import ReconstructionConfig, prepare, preset
from endo_sim_ros.reconstruction.from_bag import reconstruct_bag
from endo_sim_ros.reconstruction.priors.network import align, load_network, network_depth
from endo_sim_ros.reconstruction.priors.sources import depth_source, estimate_depth
from endo_sim_ros.reconstruction.scene import ScenePoints
from endo_sim_ros.reconstruction.stage_configs import NetworkDepthConfig
from endo_sim_ros.reconstruction.triangulation import triangulate
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

ONNX = Path(__file__).resolve().parents[3] / "shared/data/weights/tcmonodepth_tcsmallnet_192x320.onnx"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A checkpoint of Depth-Anything's architecture with random weights."""
    transformers = pytest.importorskip("transformers")
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, intermediate_size=32, image_size=70, patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8, head_hidden_size=8,
        reassemble_factors=[4, 2, 1, 0.5], patch_size=14, head_in_index=-1,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("hub") / "models--depth-anything--Depth-Anything-V2-Small-hf/snapshots/0123"
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    return folder


def test_a_checkpoint_is_read_from_a_folder_or_the_cache(tiny, monkeypatch):
    image = np.random.default_rng(0).integers(0, 255, (60, 83, 3), np.uint8)
    depth = load_network(str(tiny), "cpu")(image)
    assert depth.shape == (60, 83) and depth.dtype == np.float32 and np.isfinite(depth).all()
    monkeypatch.setenv("HF_HUB_CACHE", str(tiny.parents[2]))
    np.testing.assert_array_equal(load_network("", "cpu")(image), depth)


@pytest.fixture(scope="module")
def tiny_networks(tiny, tmp_path_factory):
    """Checkpoints of other architectures with random weights: metric, ZoeDepth, DPT."""
    transformers = pytest.importorskip("transformers")
    folders = {name: tmp_path_factory.mktemp(name) for name in ("metric", "zoedepth", "dpt")}
    metric = transformers.DepthAnythingForDepthEstimation.from_pretrained(tiny)
    metric.config.depth_estimation_type, metric.config.max_depth = "metric", 20
    metric.save_pretrained(folders["metric"])
    beit = transformers.BeitConfig(
        image_size=64, patch_size=16, hidden_size=16, num_hidden_layers=4, num_attention_heads=2, intermediate_size=32,
        out_features=["stage1", "stage2", "stage3", "stage4"], reshape_hidden_states=False, use_relative_position_bias=True,
    )  # fmt: skip
    zoe = transformers.ZoeDepthConfig(
        backbone_config=beit, backbone_hidden_size=16, neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8, bottleneck_features=8,
        num_relative_features=4, bin_embedding_dim=8, num_attractors=[4, 2, 2, 1], num_patch_transformer_layers=1,
        patch_transformer_hidden_size=8, patch_transformer_intermediate_size=16, patch_transformer_num_attention_heads=2,
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}],
    )  # fmt: skip
    transformers.ZoeDepthForDepthEstimation(zoe).save_pretrained(folders["zoedepth"])
    transformers.ZoeDepthImageProcessor(size={"height": 64, "width": 64}).save_pretrained(folders["zoedepth"])
    dpt = transformers.DPTConfig(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, intermediate_size=32, image_size=64, patch_size=16,
        backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8, is_hybrid=False,
    )  # fmt: skip
    transformers.DPTForDepthEstimation(dpt).save_pretrained(folders["dpt"])
    transformers.DPTImageProcessor(size={"height": 64, "width": 64}).save_pretrained(folders["dpt"])
    return folders


@pytest.mark.slow
@pytest.mark.parametrize("name", ["zoedepth", "dpt"])
def test_any_depth_network_of_transformers_is_read_with_its_own_preprocessing(tiny_networks, name):
    image = np.random.default_rng(0).integers(0, 255, (60, 83, 3), np.uint8)
    inverse = load_network(str(tiny_networks[name]), "cpu")(image)
    assert inverse.shape == (60, 83) and inverse.dtype == np.float32 and np.isfinite(inverse).all()
    if name == "zoedepth":  # metres of a room
        assert 0.09 < inverse.min() <= inverse.max() < 1001


def test_metric_depth_is_inverted(tiny, tiny_networks):
    image = np.random.default_rng(0).integers(0, 255, (60, 83, 3), np.uint8)
    inverse = load_network(str(tiny_networks["metric"]), "cpu")(image)
    assert 1 / 20 <= inverse.min() and np.isfinite(inverse).all()
    assert not np.allclose(inverse, load_network(str(tiny), "cpu")(image))


def test_an_absent_network_is_told_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    (tmp_path / "images").mkdir()
    with pytest.raises(SequenceError, match="no checkpoint of a depth network; copy the folder"):
        load_network("", "cpu")
    for name in ("nowhere", "images"):
        path = str(tmp_path / name)
        with pytest.raises(SequenceError, match=f"{name}: there is no .* give its path as depth_model"):
            load_network(path, "cpu")
        with pytest.raises(SequenceError, match=f"{name}: there is no .* give its path as depth_model"):
            reconstruct_bag(tmp_path / "no_bag", tmp_path / "out", ReconstructionConfig(depth_model=path))
    assert not (tmp_path / "out").exists()


def test_a_damaged_network_is_one_clear_error(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "bad.onnx").write_bytes(b"nothing")
    with pytest.raises(SequenceError, match=r"bad.onnx: not a readable depth network"):
        load_network(str(tmp_path / "bad.onnx"), "cpu")


def test_alignment_survives_outliers_and_refuses_what_does_not_fit():
    rng = np.random.default_rng(0)
    inverse = rng.uniform(5, 15, 200)
    relative = (inverse - 2) / 7
    wrong = inverse.copy()
    wrong[:60] = rng.uniform(2, 30, 60)
    scale, shift, error = align(relative, wrong)
    assert scale == pytest.approx(7, rel=0.02) and shift == pytest.approx(2, abs=0.15) and error < 0.02
    assert align(rng.random(200), inverse) is None  # nothing to do with it
    assert align(-relative, inverse) is None  # depth instead of inverse depth
    assert align(relative[:5], inverse[:5]) is None
    assert align(np.ones(200), inverse) is None
    noisy = inverse * rng.normal(1, 0.02, 200)
    assert align(relative, noisy) is not None and align(relative, noisy, NetworkDepthConfig(max_error=0.005)) is None
    flat = rng.uniform(9.8, 10.2, 200)  # one depth for all is hardly off: a network that tells no more is none
    assert align(rng.random(200), flat) is None


@pytest.fixture(scope="module")
def views():
    return list(phantom_sequence(PhantomConfig(width=320, height=256, frames=3, stereo=False)))


@pytest.mark.slow
def test_a_networks_depth_becomes_metric(views):
    """A network that sees the exact shape, up to scale and shift, gives the exact depth."""
    frame = views[0]
    points = triangulate(views).positions
    uv, z = frame.camera.project(points)
    inside = (uv >= 0).all(1) & (uv < [320, 256]).all(1)
    known = np.column_stack([uv, z])[inside]
    depth = network_depth(frame, lambda image: (1 / frame.depth - 3) / 11, known)
    assert np.median(np.abs(depth / frame.depth - 1)) < 0.01
    assert network_depth(frame, lambda image: np.random.default_rng(0).random((256, 320)), known) is None


@pytest.mark.slow
def test_views_that_do_not_fit_are_dropped_and_none_at_all_is_an_error(views, tiny):
    points = triangulate(views)
    with pytest.raises(SequenceError, match="no view's depth fits"):
        estimate_depth(unknown(views), points, ReconstructionConfig(depth="network", depth_model=str(tiny), device="cpu"))
    with pytest.raises(SequenceError, match="no view's depth fits"):
        estimate_depth(unknown(views), points, ReconstructionConfig(depth_model=str(tiny), device="cpu"))
    unscaled = estimate_depth(unknown(views), ScenePoints.none(), ReconstructionConfig(depth_model=str(tiny), device="cpu"))
    assert all(view.depth_prior is None for view in unscaled)


@pytest.mark.slow
def test_published_methods_take_a_network_first_and_say_what_they_take_instead(monkeypatch, tmp_path, caplog):
    frames = list(phantom_sequence(PhantomConfig(width=160, height=128, frames=3)))
    without = [dataclasses.replace(frame, depth=None) for frame in frames]
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    for name, config in (("paper", preset("paper", device="cpu")), ("fsgs", preset("fsgs", device="cpu"))):
        scene = prepare(without, config, triangulate(frames))
        assert scene.depth_source == "stereo", name
        assert [text for text in scene.decisions if "NOT AS PUBLISHED" in text and "it is from stereo" in text] == [*scene.decisions], name
    assert caplog.text.count("NOT AS PUBLISHED") == 2
    checkpoint = preset("paper", depth_model=str(tmp_path))
    assert depth_source(frames, checkpoint) == "network" != depth_source(frames, ReconstructionConfig(depth_model=str(tmp_path)))


@pytest.mark.slow
@pytest.mark.skipif(not ONNX.is_file(), reason="no ONNX depth network at ../shared/data/weights")
def test_a_real_network_gives_depth_that_correlates(views):
    pytest.importorskip("onnxruntime")
    relative = load_network(str(ONNX), "cpu")(views[0].image)
    assert relative.shape == (256, 320) and np.isfinite(relative).all()
    assert abs(np.corrcoef(relative.ravel(), 1 / views[0].depth.ravel())[0, 1]) > 0.3


@pytest.mark.slow
def test_views_that_fit_get_the_depth_of_the_network(views, monkeypatch, tmp_path):
    """The network is loaded once, whatever the views."""
    loaded, depths = [], {view.image.tobytes(): view.depth for view in views}

    def load(path, device):
        loaded.append(path)
        return lambda image: (1 / depths[image.tobytes()] - 3) / 11

    monkeypatch.setattr("endo_sim_ros.reconstruction.priors.sources.load_network", load)
    config = ReconstructionConfig(depth="network", depth_model=str(tmp_path), device="cpu")
    found = estimate_depth(unknown(views), triangulate(views), config)
    assert len(loaded) == 1
    assert all(np.median(np.abs(view.depth_prior / frame.depth - 1)[view.depth_prior > 0]) < 0.01 for view, frame in zip(found, views))
