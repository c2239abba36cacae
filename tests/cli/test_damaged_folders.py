"""A few damaged folders and files; `make fuzz` tries thousands."""

import damaged_files
import damaged_folders
import pytest

CASES, SEED = 24, 0


@pytest.mark.long
def test_no_damage_gives_a_traceback_or_another_number(run_folder, tmp_path):
    damaged_folders.make_runs(tmp_path, run_folder)
    tried = damaged_folders.cases(tmp_path, CASES, SEED)
    expected = damaged_folders.baselines(tmp_path, {(case.run, case.command) for case in tried})
    found = [(case, damaged_folders.wrong(tmp_path, expected, case)) for case in tried]
    assert not [(case, outcome) for case, outcome in found if outcome]


@pytest.mark.parametrize("cases", [15, pytest.param(60, marks=pytest.mark.long)])
def test_no_damage_of_a_policy_an_export_labels_or_a_teacher_gives_another_value(tmp_path, cases):
    expected = damaged_files.make_folders(tmp_path)
    found = [
        (case, damaged_files.wrong(tmp_path, expected, case)) for case in damaged_files.cases(tmp_path, cases, SEED)
    ]
    assert not [(case, outcome) for case, outcome in found if outcome]
