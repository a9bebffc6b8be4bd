"""What can go wrong, and the test that fails where it would go wrong unnoticed.

| fault | test |
|---|---|
| SIGKILL during a write | test_files.py::test_killed_writers_leave_old_or_new |
| SIGKILL at any moment of a stage | test_kill.py::test_killed_and_continued_is_whole |
| orphaned temporary files | test_files.py::test_sweep_spares_living_writers |
| disk full while writing | test_files.py::test_full_disk |
| disk full in a run: what to do | test_resume.py::test_a_full_disk_names_the_command_that_goes_on |
| disk too small for a dataset | test_executors.py::test_no_room_is_said_before_any_work |
| power loss after the rename | test_files.py::test_order_is_data_then_rename_then_directory |
| truncated file | test_checkpoints.py::test_every_truncation_is_noticed |
| truncated or missing shard | test_datasets.py::test_truncated_and_missing_shards_are_refused |
| flipped bit in a checkpoint | test_checkpoints.py::test_every_flipped_bit_is_noticed |
| flipped byte in a dataset | test_datasets.py::test_every_flipped_byte_is_noticed |
| malformed or huge header | test_checkpoints.py::test_foreign_headers_are_refused |
| header longer than the file | test_checkpoints.py::test_a_huge_header_is_not_even_read |
| mutated files of all kinds | test_fuzz.py::test_mutated_files_are_refused_or_read |
| duplicate JSON keys | test_files.py::test_json_that_lies_is_refused |
| missing, extra, misshapen tensors | test_checkpoints.py::test_check_tensors_names_the_first_difference |
| resume ends differently | test_resume.py::test_interrupted_at_any_step_and_continued_is_uninterrupted |
| state left out of a save | test_resume.py::test_each_part_of_the_state_matters |
| metrics lost or doubled on resume | test_resume.py::test_a_stop_between_saves_repeats_what_was_lost |
| half-written dataset | test_datasets.py::test_an_interrupted_collection_is_no_dataset_and_can_be_repeated |
| shard that merely exists | test_executors.py::test_an_interrupted_collection_keeps_its_shards |
| arrays that are not contiguous | test_checkpoints.py::test_any_memory_layout_round_trips |
| file mode against the umask | test_files.py::test_mode_follows_the_umask |
| loss or gradient not finite | test_resume.py::test_a_diverging_run_saves_nothing_that_is_not_finite |
| checkpoint not finite | test_checkpoints.py::test_what_is_not_finite_is_neither_written_nor_read |
| dataset not finite | test_datasets.py::test_what_is_not_finite_is_neither_written_nor_read |
| code executed on load | test_security.py::test_nothing_read_is_executed |
| names that lead out of a directory | test_zoo.py::test_names_never_lead_out_of_the_zoo |
| the same in a log of shards | test_executors.py::test_a_log_that_lies_is_not_believed |
| sizes that would fill the memory | test_fuzz.py::test_an_architecture_is_not_built_before_its_tensors_are_seen |
| order of workers shows in a dataset | test_executors.py::test_a_dataset_is_the_same_from_any_number_of_workers_and_from_a_cluster |
| order of workers shows in a table | test_executors.py::test_a_sweep_is_the_same_from_any_number_of_workers_and_from_a_cluster |
| another memory layout, other last bits | test_resume.py::test_the_optimiser_keeps_its_memory_layout |
| Ctrl-C leaves workers behind | test_evaluate.py::test_an_interrupt_ends_the_workers_at_once |
| killed parent leaves workers behind | test_evaluate.py::test_workers_end_with_a_killed_parent |
| threads change between a run's parts | test_resume.py::test_a_run_keeps_its_number_of_threads |
| batch of a divergence unknown | test_resume.py::test_the_levels_name_their_batches_too |
| process of a training killed | test_ranks.py::test_a_killed_process_ends_the_others_and_the_run_goes_on |
| processes see different files | test_ranks.py::test_processes_must_see_the_same |
| processes stop at different steps | test_ranks.py::test_all_stop_after_the_same_step_and_one_process_can_go_on |
| cluster worker killed | test_executors.py::test_a_sweep_is_the_same_from_any_number_of_workers_and_from_a_cluster |
| worker dies | test_executors.py::test_a_dead_worker_is_one_line |
| Ctrl-C and SIGTERM in training | test_resume.py::test_a_real_process_saves_and_says_how_to_go_on |
| markup in names is interpreted | test_security.py::test_a_model_of_any_name_prints_as_text |
| two processes in one directory | test_runs.py::test_a_second_process_is_locked_out |
| files of older and newer versions | test_schemas.py::test_newer_files_are_refused_with_what_to_do |
| a dependency too many | test_security.py::test_dependencies_are_few_and_bounded |
| released model is not what was measured | test_zoo_numbers.py::test_a_few_devices_score_as_on_the_card |
| released curves older than the protocol | test_zoo.py::test_verify_says_which_curves_are_not_those_of_the_defaults |
"""

import ast
import re
from pathlib import Path

import pytest

ROWS = re.findall(r"^\| (.+?) \| (test_\w+\.py)::(test_\w+) \|$", __doc__, flags=re.M)


@pytest.mark.parametrize(("fault", "file", "test"), ROWS)
def test_every_fault_has_its_test(fault: str, file: str, test: str) -> None:
    tree = ast.parse(Path(__file__).with_name(file).read_text(encoding="utf-8"))
    assert test in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_the_table_is_read() -> None:
    assert len(ROWS) == __doc__.count("::")
