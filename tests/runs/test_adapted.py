"""Policy folders whose policy.json was changed and signed anew: refused in one line, or opened as what they are."""

import copy
import json

import jax
import jax.numpy as jnp
import json_ways
import pytest
import small_policies

from cuelearner_jax import config as configuration
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.adapted import open_folder
from cuelearner_jax.storage import policy_folders

JUNK = [None, -1, 10**20, "mro", [None], float("nan")]
TOLD = ("of", "judged", "observation", "conventions", "commit", "versions", "hardware", "command", "arrays")
TOLD += ("format", "digest")


@pytest.fixture(scope="module", params=["guided", "calibrated"])
def folder(tmp_path_factory, request):
    out = tmp_path_factory.mktemp("policies") / "policy"
    small_policies.write(out, calibrated=request.param == "calibrated")
    return out


@pytest.fixture
def opened(folder, monkeypatch):
    """Opens the folder with other values, and makes the policy of arrays of zeros if they fit those on the disk."""
    path = folder / "policy.json"
    whole = path.read_text()
    shapes = []

    def zeros(_, like, described):
        found = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), like)
        if shapes and found != shapes[0]:
            raise UserError("arrays of other shapes")
        shapes.append(found)
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)

    monkeypatch.setattr(policy_folders, "read_arrays", zeros)

    def open_as(values):
        values.pop("digest", None)
        path.write_text(json.dumps({**values, "digest": configuration.digest(values)}))
        _, _, lanes = open_folder(folder, small_policies.find)
        return lanes, lanes.policy(small_policies.ENV)

    open_as(json.loads(whole))
    yield open_as, json.loads(whole)
    path.write_text(whole)


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.long)])
def test_nonsense_in_a_policy_is_refused_in_one_line_wherever_it_stands(opened, every):
    open_as, whole = opened
    refused, taken = 0, []
    ways = [way for way in json_ways.ways(whole) if way[0] not in TOLD]
    for way in [*[way for way in ways if way[-2:-1] not in (("sizes",), ("scalars",))], *ways[::4]][::every]:
        for junk in (*JUNK, json_ways.GONE):
            try:
                lanes, _ = open_as(json_ways.changed(whole, way, junk))
            except UserError as error:
                refused += 1
                assert "\n" not in str(error)
                continue
            taken.append((way, junk))
            assert len({len(column) for column in (*lanes.lanes, lanes.used)}) == 1
            assert all(isinstance(kind, str) for kind in lanes.kinds)
    odd = [way for way, junk in taken if isinstance(junk, str)]
    assert odd == [], odd
    assert refused > (150 if "sizes" in whole["policy"] else 100) / every


def test_layers_of_layers_and_policies_of_other_names_are_refused(opened):
    open_as, whole = opened
    values = copy.deepcopy(whole)
    for _ in range(40):
        values["policy"] = {**whole["policy"], "base": values["policy"]}
    with pytest.raises(UserError, match=r"policy\.json is damaged"):
        open_as(values)
    for name in ("teacher", "opaque", "hostile:KIND"):
        values = copy.deepcopy(whole)
        values["policy"]["base"] = {"policy": name}
        with pytest.raises(UserError, match=r"policy\.json is damaged"):
            open_as(values)


def test_a_base_that_is_not_there_is_no_other_ones(opened):
    open_as, whole = opened
    for change in ({"base": [0, 1]}, {"base": [0, -1]}, {"seeds": [0, 0]}, {"used": [1, 0]}, {"seeds": [0]}):
        values = copy.deepcopy(whole)
        values["lanes"] |= change
        with pytest.raises(UserError, match=r"policy\.json is damaged"):
            open_as(values)
