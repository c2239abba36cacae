"""LeRobot's reader of a dataset with pictures, without decoding 20 pictures for the 20 actions of a chunk.

    lerobot-train --dataset.discover_packages_path=_lerobot_columns ...

lerobot 0.6.1 takes the actions of a chunk from whole rows, and decodes their pictures (datasets >= 4.4 formats all
columns for a custom transform). Here columns of numbers are kept in memory; what an item holds is the same.
"""

from __future__ import annotations

import numpy as np
import torch
from lerobot.datasets.dataset_reader import DatasetReader

_whole_rows = DatasetReader._query_hf_dataset


def _columns(self: DatasetReader, query_indices: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """Return the values of each feature in the rows asked for."""
    columns = self.__dict__.setdefault("_number_columns", {})
    pictures = {key: rows for key, rows in query_indices.items() if key in self._meta.camera_keys}
    result = _whole_rows(self, pictures)
    for key in query_indices.keys() - pictures.keys():
        if key not in columns:
            columns[key] = torch.from_numpy(np.array(self.hf_dataset.data.column(key).to_pylist(), np.float32))
        number = self._absolute_to_relative_idx
        rows = query_indices[key]
        result[key] = columns[key][rows if number is None else [number[row] for row in rows]]
    return result


DatasetReader._query_hf_dataset = _columns
__path__: list[str] = []  # LeRobot looks for more modules of a plugin here
