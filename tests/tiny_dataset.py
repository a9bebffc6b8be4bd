"""Datasets of given trajectories, written as ``hjepa collect`` writes them."""

from hjepa_cli.core.datasets.dataset import per_shard, write_manifest, write_shard
from hjepa_cli.storage.shards import cut


def write_dataset(directory, *, settings, splits, plant_name, camera_manifest):
    stored = any(split.frames is not None for split in splits.values())
    sizes = {name: len(split) for name, split in splits.items()}
    shards = [
        write_shard(directory, shard, splits[shard.split][shard.start : shard.stop], plant_name)
        for shard in cut(sizes, per_shard(stored))
    ]
    return write_manifest(
        directory,
        settings=settings,
        shards=shards,
        plant_name=plant_name,
        camera_manifest=camera_manifest,
    )
