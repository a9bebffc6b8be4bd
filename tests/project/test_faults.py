"""What can go wrong, and the test that fails where it would go wrong unnoticed.

| | fault | test |
|---|---|---|
| 1 | SIGKILL during a write | test_files.py::test_killed_writers_leave_old_or_new |
| 1 | SIGKILL at any moment of a stage | test_kill.py::test_killed_and_continued_is_whole |
| 2 | orphaned temporary files | test_files.py::test_sweep_spares_living_writers |
| 2 | two writers of one file | test_races.py::test_two_writers_with_one_pid_do_not_meet |
| 3 | disk full while writing | test_files.py::test_full_disk |
| 3 | disk full in a training, by the kernel | test_resume.py::test_a_disk_that_really_refuses |
| 3 | disk full in a training: what to do | test_resume.py::test_a_full_disk_loses_nothing_and_names_the_command_that_goes_on |
| 3 | disk full in a collection, to its last file | test_collecting.py::test_a_full_disk_names_what_goes_on_at_every_moment |
| 3 | disk too small for a dataset | test_executors.py::test_no_room_is_said_before_any_work |
| 3 | disk large enough for the rest of one | test_collecting.py::test_room_is_needed_only_for_what_is_missing |
| 4 | power loss after the rename | test_files.py::test_order_is_data_then_rename_then_directory |
| 4 | power loss between metrics and result | test_runs.py::test_a_result_is_written_after_all_else_is_on_the_disk |
| 5 | truncated file | test_checkpoints.py::test_every_truncation_is_noticed |
| 5 | truncated or missing shard | test_datasets.py::test_truncated_and_missing_shards_are_refused |
| 6 | flipped bit in a checkpoint | test_checkpoints.py::test_every_flipped_bit_is_noticed |
| 6 | flipped byte in a dataset | test_datasets.py::test_every_flipped_byte_is_noticed |
| 7 | malformed or huge header | test_checkpoints.py::test_foreign_headers_are_refused |
| 7 | header longer than the file | test_checkpoints.py::test_a_huge_header_is_not_even_read |
| 7 | header that would not be read again | test_checkpoints.py::test_what_could_not_be_read_again_is_not_written |
| 7 | dimensions that overflow | test_checkpoints.py::test_a_dimension_beyond_all_numbers_is_refused |
| 7 | mutated files of all kinds | test_fuzz.py::test_mutated_files_are_refused_or_read |
| 8 | duplicate JSON keys | test_files.py::test_json_that_lies_is_refused |
| 8 | missing, extra, misshapen tensors | test_checkpoints.py::test_check_tensors_names_the_first_difference |
| 8 | saved state that lies | test_resume.py::test_a_state_that_lies_is_refused |
| 9 | resume ends differently | test_resume.py::test_interrupted_at_any_step_and_continued_is_uninterrupted |
| 9 | state left out of a save | test_resume.py::test_each_part_of_the_state_matters |
| 9 | another memory layout, other last bits | test_resume.py::test_the_optimiser_keeps_its_memory_layout |
| 10 | metrics lost or doubled on resume | test_resume.py::test_a_stop_between_saves_repeats_what_was_lost |
| 10 | metrics too long for a header | test_resume.py::test_a_long_history_outgrows_no_header |
| 11 | half-written dataset | test_datasets.py::test_an_interrupted_collection_is_no_dataset_and_can_be_repeated |
| 11 | shard that merely exists | test_executors.py::test_an_interrupted_collection_keeps_its_shards |
| 11 | log of shards without a first line | test_collecting.py::test_a_log_has_its_first_line_or_is_not_there |
| 11 | shards of another division | test_collecting.py::test_a_log_that_describes_other_shards_is_not_believed |
| 12 | arrays that are not contiguous | test_checkpoints.py::test_any_memory_layout_round_trips |
| 13 | file mode against the umask | test_files.py::test_mode_follows_the_umask |
| 14 | loss or gradient not finite | test_resume.py::test_a_diverging_run_saves_nothing_that_is_not_finite |
| 14 | batch of a divergence unknown | test_resume.py::test_the_levels_name_their_batches_too |
| 14 | checkpoint not finite | test_checkpoints.py::test_what_is_not_finite_is_neither_written_nor_read |
| 14 | dataset not finite | test_datasets.py::test_what_is_not_finite_is_neither_written_nor_read |
| 14 | simulation not finite | test_collecting.py::test_a_simulation_that_diverges_is_a_numerical_failure |
| 14 | NaN in a flag | test_bad_input.py::test_numbers_are_finite_and_not_negative |
| 15 | code executed on load | test_security.py::test_nothing_read_is_executed |
| 16 | names that lead out of a directory | test_zoo.py::test_names_never_lead_out_of_the_zoo |
| 16 | the same in a manifest | test_datasets.py::test_a_manifest_that_lies_is_refused |
| 16 | the same in a log of shards | test_executors.py::test_a_log_that_lies_is_not_believed |
| 16 | links that lead out of a directory | test_races.py::test_nothing_is_written_to_where_links_lead |
| 17 | sizes that would fill the memory | test_fuzz.py::test_an_architecture_is_not_built_before_its_tensors_are_seen |
| 17 | file larger than what it should hold | test_datasets.py::test_a_shard_larger_than_its_tensors_is_not_even_read |
| 17 | dataset larger than its manifest may be | test_collecting.py::test_more_than_a_manifest_can_list_is_refused_at_once |
| 18 | order of workers shows in a dataset | test_executors.py::test_a_dataset_is_the_same_from_any_number_of_workers_and_from_a_cluster |
| 18 | order of workers shows in a table | test_executors.py::test_a_sweep_is_the_same_from_any_number_of_workers_and_from_a_cluster |
| 18 | threads change between a run's parts | test_resume.py::test_a_run_keeps_its_number_of_threads |
| 18 | workers of another version | test_executors.py::test_workers_must_be_there_and_compute_the_same |
| 19 | Ctrl-C and SIGTERM in training | test_resume.py::test_a_real_process_saves_and_says_how_to_go_on |
| 19 | Ctrl-C and SIGTERM to a whole group | test_races.py::test_ctrl_c_leaves_no_process_behind_and_the_command_goes_on |
| 19 | Ctrl-C leaves workers behind | test_evaluate.py::test_an_interrupt_ends_the_workers_at_once |
| 19 | killed parent leaves workers behind | test_evaluate.py::test_workers_end_with_a_killed_parent |
| 19 | processes of others ended with ours | test_races.py::test_the_caller_s_own_processes_survive_ours |
| 19 | worker dies | test_executors.py::test_a_dead_worker_is_one_line |
| 19 | worker dies with a lock | test_races.py::test_a_worker_that_dies_with_the_lock_of_progress_stops_nobody |
| 19 | cluster worker killed | test_executors.py::test_a_sweep_is_the_same_from_any_number_of_workers_and_from_a_cluster |
| 19 | cluster's scheduler killed | test_executors.py::test_a_scheduler_that_ends_is_one_line |
| 19 | process of a training killed | test_ranks.py::test_a_killed_process_ends_the_others_and_the_run_goes_on |
| 19 | processes see different files | test_ranks.py::test_processes_must_see_the_same |
| 19 | processes stop at different steps | test_ranks.py::test_all_stop_after_the_same_step_and_one_process_can_go_on |
| 20 | markup in names is interpreted | test_security.py::test_a_model_of_any_name_prints_as_text |
| 20 | markup in names in a report | test_report.py::test_names_cannot_smuggle_markup_in |
| 20 | text of a lock file is repeated | test_races.py::test_what_stands_in_a_foreign_lock_is_not_repeated |
| 21 | two processes in one directory | test_runs.py::test_a_second_process_is_locked_out |
| 21 | nobody knows who works there | test_races.py::test_a_refusal_says_who_is_working_there |
| 21 | two evaluations of one model | test_races.py::test_evaluations_that_share_a_file_of_curves_lose_none |
| 22 | files of older and newer versions | test_schemas.py::test_newer_files_are_refused_with_what_to_do |
| 22 | a format without its old files | test_schemas.py::test_a_fixture_for_every_version |
| 22 | run of a version with fewer settings | test_runs.py::test_what_an_older_version_had_not_is_as_its_preset_says |
| 22 | collection of another version | test_collecting.py::test_a_collection_of_an_older_version_goes_on |
| 22 | saved state of an older version | test_resume.py::test_a_state_whose_metrics_were_in_the_header_goes_on |
| 23 | a dependency too many | test_security.py::test_dependencies_are_few_and_bounded |
| 23 | a download | test_security.py::test_the_guard_sees_it |
| 24 | released model is not what was measured | test_zoo_numbers.py::test_a_few_devices_score_as_on_the_card |
| 24 | released curves older than the protocol | test_zoo.py::test_verify_says_which_curves_are_not_those_of_the_defaults |
"""

import ast
import re
from pathlib import Path

import pytest

ROWS = re.findall(r"^\| (\d+) \| (.+?) \| (test_\w+\.py)::(test_\w+) \|$", __doc__, flags=re.M)
FAULTS = 24  # kinds that have happened to others


@pytest.mark.parametrize(("kind", "fault", "file", "test"), ROWS)
def test_every_fault_has_its_test(kind: str, fault: str, file: str, test: str) -> None:
    (path,) = Path(__file__).parents[1].rglob(file)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert test in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_the_table_is_read() -> None:
    assert len(ROWS) == __doc__.count("::")
    assert {int(kind) for kind, *_ in ROWS} == set(range(1, FAULTS + 1))
