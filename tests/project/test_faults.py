"""What can go wrong, and the test that fails where it would go wrong unnoticed.

| | fault | test |
|---|---|---|
| 1 | SIGKILL during a write | test_files.py::test_killed_writers_leave_old_or_new |
| 1 | SIGKILL at any moment of a stage | test_kill.py::test_killed_while_it_writes_and_continued_is_whole |
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
| 11 | half-written dataset | test_datasets.py::test_an_interrupted_collection_is_no_dataset |
| 11 | shard that merely exists | test_executors.py::test_an_interrupted_collection_keeps_its_shards |
| 11 | log of shards without a first line | test_collecting.py::test_a_log_has_its_first_line_or_is_not_there |
| 11 | shards of another division | test_collecting.py::test_a_log_that_describes_other_shards_is_not_believed |
| 11 | episodes left out before a stop, and taken after it | test_import.py::test_a_resumed_import_tells_each_flaw_once_and_asks_for_what_is_missing |
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
| 19 | Ctrl-C loses what was measured of survival | test_survival.py::test_an_interruption_loses_no_curve_that_was_measured |
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
| 25 | a digit of measured curves changed | test_seals.py::test_one_digit_of_curves_is_noticed_by_verify_and_scale |
| 25 | a seal taken away | test_seals.py::test_curves_of_the_present_schema_without_a_seal_are_refused |
| 25 | curves of before there were seals as a cache | test_seals.py::test_curves_without_a_seal_are_read_where_they_are_named_and_never_a_cache |
| 25 | reversed intervals, values out of range | test_seals.py::test_impossible_values_are_refused_under_the_right_seal |
| 25 | a result or a table of a run changed | test_seals.py::test_results_and_tables_are_sealed |
| 25 | the run around a model changed | test_seals.py::test_verify_checks_the_run_around_a_model |
| 25 | any byte of a derived file changed | test_seals.py::test_no_mutation_changes_what_is_read |
| 26 | code from the current directory | test_races.py::test_children_import_nothing_from_the_current_directory |
| 27 | settings of a run changed under it | test_seals.py::test_settings_that_were_changed_are_named |
| 27 | a run of other flags told as the answer | test_runs.py::test_a_run_with_other_flags_is_not_the_one_that_is_asked_for |
| 27 | saved state of other settings | test_resume.py::test_a_state_goes_on_under_its_own_settings_only |
| 28 | a setting that nothing reads | test_radio_input.py::test_what_the_law_would_not_read_is_refused_from_wherever_it_comes |
| 28 | the same of one simulated uplink | test_api.py::test_a_simulated_cell_refuses_settings_that_it_does_not_read |
| 28 | settings of other stages refused | test_radio_input.py::test_settings_of_a_cell_do_not_concern_other_stages |
| 29 | put on a bound, and refused by it | test_hall.py::test_who_is_pushed_out_to_the_bound_stands_on_it |
| 29 | a rounding error beyond a bound | test_channel.py::test_what_rounding_puts_beside_a_bound_is_on_it |
| 29 | a packet that fills its slot | test_capacity.py::test_a_packet_that_fills_its_slot_exactly_is_on_time |
| 30 | exports that only the newest library reads | test_data_tools.py::test_hdf5_is_of_a_layout_that_all_libraries_read_and_append_to |
| 31 | targets that are no regular files | test_files.py::test_special_files_are_refused_and_stay |
| 31 | links as targets | test_files.py::test_links_that_a_person_names_are_followed |
| 31 | the same on the command line | test_data_tools.py::test_an_export_follows_links_and_refuses_pipes |
| 32 | NaN in a state that is drawn | test_not_finite.py::test_a_camera_draws_no_garbage |
| 32 | NaN in a state or force that is simulated | test_not_finite.py::test_a_simulation_goes_on_as_if_nothing_had_been_asked |
| 32 | NaN in a state or noise of a public cart-pole | test_not_finite.py::test_one_cart_pole_stays_as_it_was |
| 32 | NaN in what equations and teachers are asked | test_not_finite.py::test_equations_and_teachers_answer_no_garbage |
| 32 | NaN in what a model is asked | test_not_finite.py::test_a_model_answers_no_garbage |
| 33 | results that do not get out | test_streams.py::test_results_that_do_not_get_out_are_one_line_and_74 |
| 33 | an error that cannot be told | test_streams.py::test_an_error_keeps_its_code_where_it_cannot_be_told |
| 33 | streams closed at the start | test_streams.py::test_a_closed_stream_is_the_null_device |
| 33 | streams that are None | test_streams.py::test_streams_that_are_none_are_the_null_device |
| 33 | a file in the place of a stream | test_streams.py::test_no_file_of_ours_is_what_a_closed_stream_was |
| 33 | a full log disk during a run | test_streams.py::test_a_run_survives_a_full_log_disk |
| 34 | a launcher's variable missing or wrong | test_launcher.py::test_a_variable_that_is_wrong_is_named |
| 34 | a process that never comes | test_launcher.py::test_a_peer_that_never_comes_is_waited_for_aloud_and_interruptibly |
| 34 | a launcher's port taken | test_launcher.py::test_a_port_that_is_taken_is_named |
| 35 | a directory moved under a run | test_odd_disks.py::test_a_run_whose_directory_was_moved_writes_into_no_other |
| 35 | the same, deleted | test_odd_disks.py::test_a_deleted_directory_is_not_made_again |
| 35 | two collections in one place | test_odd_disks.py::test_two_collections_one_in_the_place_of_the_other_do_not_mix |
| 35 | a worker's directory moved | test_odd_disks.py::test_a_worker_writes_into_the_directory_that_was_locked |
| 36 | memory runs out | test_memory.py::test_running_out_of_memory_is_no_error_to_report |
| 36 | sizes beyond the memory | test_memory.py::test_sizes_beyond_the_memory_are_refused_before_any_work |
| 36 | sizes beyond all machines | test_memory.py::test_sizes_have_upper_bounds |
| 36 | a dataset beyond the memory | test_memory.py::test_a_training_beyond_the_memory_is_refused |
| 36 | a split beyond the memory | test_memory.py::test_an_export_beyond_the_memory_is_refused |
| 36 | an export that is held whole | test_memory.py::test_an_export_takes_no_more_memory_for_more_trajectories |
| 37 | a disk without locks | test_odd_disks.py::test_a_disk_without_locks_is_said_and_used |
| 37 | a disk that flushes no directories | test_odd_disks.py::test_a_disk_that_cannot_flush_directories_is_used |
| 37 | a system without semaphores | test_odd_disks.py::test_without_semaphores_there_is_one_process |
| 38 | paths that are no UTF-8 | test_paths.py::test_any_bytes_are_a_path_wherever_one_is_written |
| 38 | a locale of few characters | test_paths.py::test_a_locale_of_few_characters_is_enough |
| 39 | a hint that fails in its turn | test_hints.py::test_a_hint_that_cannot_be_followed_is_noticed |
| 40 | results of others, or damaged | test_foreign_records.py::test_a_result_that_is_none_of_its_stage_is_refused |
| 40 | records of others, or damaged | test_foreign_records.py::test_surroundings_that_are_none_are_refused |
| 40 | a digit changed in any record of a run | test_foreign_records.py::test_a_digit_changed_in_any_record_of_a_finished_run_is_noticed |
| 40 | one damaged shard that hides others | test_foreign_records.py::test_one_damaged_shard_does_not_hide_the_others |
| 41 | data in which nothing moves | test_degenerate.py::test_data_in_which_nothing_moves_are_refused_at_the_start |
| 41 | data in which nothing is seen to move | test_degenerate.py::test_movements_that_no_camera_sees_are_refused_before_training |
| 41 | a measure that is undefined | test_degenerate.py::test_what_is_undefined_is_none |
| 42 | a cluster's address that is silent | test_strange_clusters.py::test_a_listener_that_is_no_scheduler_is_soon_refused |
| 42 | a scheduler's file of another program | test_strange_clusters.py::test_a_file_that_no_scheduler_wrote_is_refused |
| 43 | a dry run that promises too much | test_small_things.py::test_a_dry_run_refuses_what_the_command_would |
| 43 | conditions beyond all things | test_small_things.py::test_sizes_of_conditions_are_those_of_things |
| 44 | arrays of other layouts | test_outside.py::test_any_memory_layout_is_read_right |
| 44 | empty arrays | test_outside.py::test_an_empty_batch_has_no_embeddings |
| 44 | pictures of other types and shapes | test_outside.py::test_other_pictures_are_refused_with_what_they_are |
| 44 | embeddings of other types and shapes | test_outside.py::test_other_embeddings_are_refused |
| 44 | states of other types and shapes | test_outside.py::test_other_states_are_refused_by_teachers_and_cart_poles |
| 44 | links of other types and shapes | test_outside.py::test_the_radio_refuses_what_is_no_array_or_does_not_go_together |
| 44 | a plant that answers something else | test_answers.py::test_a_plant_that_answers_wrong_is_named |
| 44 | a plant that changes what it is given | test_answers.py::test_what_a_plant_does_to_its_arrays_is_its_own |
| 45 | an environment that cannot be made again | test_gym_copies.py::test_an_environment_is_made_again_from_its_spec |
| 45 | an environment that cannot be copied | test_gym_copies.py::test_a_copy_goes_on_where_the_original_is |
| 46 | a model of preset smoke as the newest | test_smoke.py::test_a_smoke_model_is_nobody_s_default |
| 46 | the newest by the time of a file | test_runs.py::test_newest_run_is_finished_and_fits |
| 47 | largest values beyond the last code | test_integers.py::test_no_value_is_off_by_more_than_half_a_step |
| 48 | a second Ctrl-C, and the end of a terminal | test_interrupts.py::test_a_signal_is_one_line_and_a_second_one_ends_at_once |
| 48 | a signal that is ignored from outside | test_interrupts.py::test_nohup_is_respected |
| 48 | a directory that is read-only | test_bad_input.py::test_a_read_only_directory_is_refused_to_everybody |
| 48 | a large file of another program | test_small_things.py::test_a_large_foreign_file_is_not_read_beyond_its_header |
| 48 | figures that overwrite each other | test_small_things.py::test_figures_of_two_runs_of_a_stage_have_two_names |
| 48 | a notebook's variables | test_small_things.py::test_a_notebook_s_backend_does_not_matter |
| 48 | nobody within reach | test_small_things.py::test_a_hall_that_covers_few_says_so |
| 49 | pictures that show nothing known | test_familiarity.py::test_garbage_is_flagged_and_ordinary_packets_are_not |
| 49 | a camera that is frozen | test_familiarity.py::test_a_camera_that_shows_the_same_for_long_is_flagged |
| 49 | flags without end | test_familiarity.py::test_flagged_packets_are_kept_back_but_no_more_than_the_limit_in_a_row |
| 49 | conditions that there are not | test_stress.py::test_what_is_no_condition_is_refused |
| 49 | frames that a device has forgotten | test_frames_apart.py::test_frames_that_a_device_has_forgotten_are_refused |
| 49 | an exposure of more than a step | test_sensor.py::test_what_a_camera_cannot_have_is_refused |
| 49 | rows of actions that fit alike | test_alignment.py::test_what_is_left_decides |
| 49 | a column of a table taken twice | test_import.py::test_tables_of_other_programs_are_read_or_refused_by_what_is_in_them |
| 49 | columns of a table in another order | test_import.py::test_columns_are_found_by_their_names_in_every_table |
| 50 | forged tag on a hello | test_controller.py::test_another_key_another_model_another_version_and_no_place |
| 50 | forged tag in a session | test_controller.py::test_a_hundred_thousand_bad_datagrams_change_nothing |
| 50 | datagram that is doubled, late or reflected | test_controller.py::test_old_doubled_and_foreign_datagrams_change_nothing |
| 50 | hello that was recorded | test_controller.py::test_a_recorded_session_proves_nothing_to_a_new_server |
| 50 | the same, in a handshake under way | test_controller.py::test_recorded_hellos_do_not_end_a_handshake_under_way |
| 50 | sessions that nobody proves | test_controller.py::test_silent_devices_are_forgotten_and_memory_is_bounded |
| 50 | device that sends too much | test_controller.py::test_one_device_cannot_take_more_than_its_allowance |
| 50 | stranger that spends the allowance of others | test_controller.py::test_who_has_no_key_spends_no_device_s_allowance |
| 50 | hello of another version without a tag | test_controller.py::test_who_has_no_key_is_of_no_version |
| 50 | answer of another version without a tag | test_controller.py::test_an_older_server_is_told_from_a_newer_one |
| 50 | step near 2³² | test_datagrams.py::test_a_step_that_no_session_has_is_refused |
| 50 | numbers of a session that end | test_controller.py::test_a_session_whose_numbers_end_ends_alone |
| 50 | the same, on the device | test_drive.py::test_steps_beyond_those_of_a_session_begin_another_one |
| 50 | round trip longer than tries are apart | test_controller.py::test_a_device_connects_over_a_long_round_trip |
| 50 | server without a place | test_drive.py::test_a_device_that_has_no_place_drives_itself_and_goes_on_asking |
| 50 | refusal that is for good | test_drive.py::test_a_refusal_that_cannot_pass_or_leaves_nobody_to_drive_ends |
| 50 | server that is silent | test_controller.py::test_silence_holds_then_the_actor_on_the_device_drives |
| 50 | force beyond the limit | test_controller.py::test_forces_are_clipped_to_the_limit |
"""

import re
from pathlib import Path

import pytest
from test_benchmarks import load

ROWS = re.findall(r"^\| (\d+) \| (.+?) \| (test_\w+\.py)::(test_\w+) \|$", __doc__, flags=re.M)
FAULTS = 50  # kinds: 24 that have happened to others, then those found by trying
GUARDS = load("guards")


@pytest.mark.parametrize(("kind", "fault", "file", "test"), ROWS)
def test_every_fault_has_its_test(kind: str, fault: str, file: str, test: str) -> None:
    """It is there, it is not skipped, and ``benchmarks/guards.py`` can take its guard away."""
    (path,) = Path(__file__).parents[1].rglob(file)
    text = path.read_text(encoding="utf-8")
    before, found, _ = text.partition(f"\ndef {test}(")
    assert found, f"{file} has no {test}"
    decorators = before[before.rindex("\n\n") :]
    assert not re.search(r"mark\.skip|xfail", decorators)
    assert GUARDS.stale(f"{file}::{test}") is None


def test_the_table_is_read() -> None:
    assert len(ROWS) == __doc__.count("::")
    assert {int(kind) for kind, *_ in ROWS} == set(range(1, FAULTS + 1))
    assert [(fault, f"{file}::{test}") for _, fault, file, test in ROWS] == GUARDS.rows()
    assert GUARDS.GUARDS.keys() == {f"{file}::{test}" for _, _, file, test in ROWS}


def test_a_test_without_teeth_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its guard gone, it still passes; and with the guard that matters gone it fails."""
    test = "test_security.py::test_dependencies_are_few_and_bounded"
    files = [path for path in GUARDS.tracked() if path.suffix in (".py", ".toml")]
    assert not GUARDS.survives(test, files)
    harmless = ("../pyproject.toml", 'readme = "README.md"', 'readme = "LICENSE"')
    monkeypatch.setitem(GUARDS.GUARDS, test, (harmless,))
    assert GUARDS.survives(test, files)
    monkeypatch.setitem(GUARDS.GUARDS, test, (("errors.py", "no such text", ""),))
    assert "0 times" in str(GUARDS.stale(test))
