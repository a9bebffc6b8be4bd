"""Tests of tests: each row of the fault table loses its guard, and its test must then fail.

    python benchmarks/guards.py --only test_files.py --jobs 2

The table is in ``tests/project/test_faults.py``. For every row this script has the smallest change
of the program that takes the guard away. It makes the change in a copy, runs the row's test there,
and counts the test that still passes as one that proves nothing. Prints a line per row; exit code 1
where a test has survived. ``tests/project/test_faults.py`` sees to it that every row has a change,
and that the text that it replaces is still there.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tests" / "project" / "test_faults.py"
LONGEST_S = 900

Change = tuple[str, str, str]
"""A file below hjepa_cli, a text that is in it once, and what takes its place."""

FILES, RUNS, SEALS, SHARDS = (f"storage/{name}.py" for name in ("files", "runs", "seals", "shards"))
TENSORS, CHECKPOINTS, ZOO = (f"storage/{name}.py" for name in ("tensors", "checkpoints", "zoo"))
DATASET, PROGRESS = "core/datasets/dataset.py", "core/training/progress.py"
EXECUTORS, WORKERS = "compute/executors.py", "core/evaluation/workers.py"
INTERRUPTS, RANKS = "compute/interrupts.py", "core/training/ranks.py"
OPTIMISER, COLLECT, CURVES = (
    "core/training/optimiser.py",
    "stages/collect.py",
    "core/evaluation/curves.py",
)
STREAMS, APP, CHECKS, SCREEN = (
    "output/streams.py",
    "cli/app.py",
    "config/checks.py",
    "output/screen.py",
)
CHANNEL, ARRAYS, MODEL = "core/radio/channel.py", "core/arrays.py", "core/networks/model.py"
CONTROLLER, DEVICE, DRIVE, PROTOCOL = (
    f"wire/{name}.py" for name in ("controller", "device", "drive", "protocol")
)

NOT_ATOMIC = (
    (FILES, 'with open(temporary, "wb") as file:', 'with open(path, "wb") as file:'),
    (FILES, "os.replace(temporary, path)", "pass"),
)
NOTHING_SWEPT = ((FILES, "                (directory / name).unlink()", "                pass"),)
OTHER_NUMBERS = ((PROGRESS, "stream.bit_generator.state = self._saved.stream", "pass"),)
NO_SEAL = ((SEALS, "if document.get(SEAL) != sealed(document, tensors)[SEAL]:", "if False:"),)
MALFORMED = (
    (
        TENSORS,
        "_MALFORMED = (\n    SafetensorError,\n    ValueError,\n    LookupError,\n    TypeError,\n"
        "    AttributeError,\n    ArithmeticError,",
        "_MALFORMED = (\n    ZeroDivisionError,",
    ),
)
NO_FINITE = ((ARRAYS, "if not np.isfinite(array).all():", "if False:"),)
NOTHING_RESUMES = (
    (FILES, "error.hint = f\"{(error.hint or '').removesuffix(_AGAIN)}{command}\"", "pass"),
)
MEMORY = (
    ("compute/memory.py", "if need_bytes > (limit := limit_bytes()):", "limit = 0\n    if False:"),
)
NOT_HELD = ((FILES, "    if inode is None:\n        return\n", "    return\n"),)

GUARDS: dict[str, tuple[Change, ...]] = {
    # 1 – 4: writing
    "test_files.py::test_killed_writers_leave_old_or_new": NOT_ATOMIC,
    "test_kill.py::test_killed_while_it_writes_and_continued_is_whole": NOTHING_SWEPT,
    "test_files.py::test_sweep_spares_living_writers": (
        (FILES, "os.kill(pid, 0)\n                    continue", "os.kill(pid, 0)"),
    ),
    "test_races.py::test_two_writers_with_one_pid_do_not_meet": (
        (FILES, 'unique = f"{secrets.token_hex(4)}.{os.getpid()}"', 'unique = f"0.{os.getpid()}"'),
    ),
    "test_files.py::test_full_disk": (
        (FILES, 'raise StorageError(f"cannot write {path}: {reason}", hint=hint) from None', "raise"),
    ),
    "test_resume.py::test_a_disk_that_really_refuses": NOTHING_RESUMES,
    "test_resume.py::test_a_full_disk_loses_nothing_and_names_the_command_that_goes_on": NOTHING_RESUMES,
    "test_collecting.py::test_a_full_disk_names_what_goes_on_at_every_moment": (
        (COLLECT, "if (directory / LOG).exists():  # else", "if True:  # else"),
    ),
    "test_executors.py::test_no_room_is_said_before_any_work": (
        (FILES, "if free_bytes < size_bytes:", "if False:"),
    ),
    "test_collecting.py::test_room_is_needed_only_for_what_is_missing": (
        (SHARDS, "size_bytes - sum(path.stat().st_size for path in there)", "size_bytes"),
    ),
    "test_files.py::test_order_is_data_then_rename_then_directory": (
        (FILES, "                _sync(file.fileno())\n            _check_held", "            _check_held"),
    ),
    "test_runs.py::test_a_result_is_written_after_all_else_is_on_the_disk": (
        (RUNS, "files.make_durable(self.path(name))", "pass"),
    ),
    # 5 – 8: reading
    "test_checkpoints.py::test_every_truncation_is_noticed": MALFORMED,
    "test_datasets.py::test_truncated_and_missing_shards_are_refused": (
        (DATASET, 'if hashlib.sha256(data).hexdigest() != shard["sha256"]:', "if False:"),
    ),
    "test_checkpoints.py::test_every_flipped_bit_is_noticed": NO_SEAL,
    "test_datasets.py::test_every_flipped_byte_is_noticed": (
        (DATASET, 'if hashlib.sha256(data).hexdigest() != shard["sha256"]:', "if False:"),
    ),
    "test_checkpoints.py::test_foreign_headers_are_refused": MALFORMED,
    "test_checkpoints.py::test_a_huge_header_is_not_even_read": (
        (TENSORS, "if length > min(HEADER_LIMIT_BYTES, size - 8):", "if False:"),
    ),
    "test_checkpoints.py::test_what_could_not_be_read_again_is_not_written": (
        (TENSORS, 'if (length := int.from_bytes(data[:8], "little")) > HEADER_LIMIT_BYTES:', "if False:"),
    ),
    "test_checkpoints.py::test_a_dimension_beyond_all_numbers_is_refused": MALFORMED,
    "test_fuzz.py::test_mutated_files_are_refused_or_read": MALFORMED,
    "test_files.py::test_json_that_lies_is_refused": (
        (FILES, "if len(keys := dict(pairs)) != len(pairs):", "if not (keys := dict(pairs)) and pairs:"),
    ),
    "test_checkpoints.py::test_check_tensors_names_the_first_difference": (
        (CHECKPOINTS, "if reason := arrays.difference(checkpoint.tensors, expected):", "if reason := None:"),
    ),
    "test_resume.py::test_a_state_that_lies_is_refused": (
        (PROGRESS, "except (msgspec.ValidationError, KeyError, ValueError) as error:", "except ZeroDivisionError as error:"),
    ),
    # 9 – 11: going on
    "test_resume.py::test_interrupted_at_any_step_and_continued_is_uninterrupted": OTHER_NUMBERS,
    "test_resume.py::test_each_part_of_the_state_matters": (
        (PROGRESS, "start = self.reached(phase)", "start, self._tensors = 0, {}"),
    ),
    "test_resume.py::test_the_optimiser_keeps_its_memory_layout": (
        (OPTIMISER, "value = torch.empty_like(parameter).copy_(value)", "pass"),
    ),
    "test_resume.py::test_a_stop_between_saves_repeats_what_was_lost": (
        (PROGRESS, "            self._record.metrics = rows", "            pass"),
    ),
    "test_resume.py::test_a_long_history_outgrows_no_header": (
        (PROGRESS, "        tensors[METRICS_ROWS] = np.array(bytearray(self._record.metrics.encode()), np.uint8)\n", ""),
        (PROGRESS, "threads, seconds, settings=settings)", "threads, seconds, self._record.metrics, settings=settings)"),
    ),
    "test_datasets.py::test_an_interrupted_collection_is_no_dataset": (
        (DATASET, "if not (path / MANIFEST).is_file():", "if not any(path.iterdir()):"),
    ),
    "test_executors.py::test_an_interrupted_collection_keeps_its_shards": (
        (SHARDS, "if hashlib.sha256(files.read_bytes(path)).hexdigest() == digest:", "if True:"),
    ),
    "test_collecting.py::test_a_log_has_its_first_line_or_is_not_there": (
        (SHARDS, "            files.write_bytes(self._path, _line(seals.sealed({**task, \"schema\": SCHEMA})))", "            self._path.touch()\n            files.write_bytes(self._path, _line(seals.sealed({**task, \"schema\": SCHEMA})))"),
    ),
    "test_collecting.py::test_a_log_that_describes_other_shards_is_not_believed": (
        (COLLECT, "return ours.items() <= log.done.get(shard.name, {}).items()", "return shard.name in log.done"),
    ),
    "test_import.py::test_a_resumed_import_tells_each_flaw_once_and_asks_for_what_is_missing": (
        ("stages/import_data.py", 'for name, described in log.done.items() if not described.get("bad")}', "for name, described in log.done.items()}"),
    ),
    # 12 – 17: arrays, modes, values, names, sizes
    "test_checkpoints.py::test_any_memory_layout_round_trips": (
        (TENSORS, 'return np.asarray(array, dtype=array.dtype.newbyteorder("="), order="C")', "return array"),
    ),
    "test_files.py::test_mode_follows_the_umask": (
        (FILES, 'with open(temporary, "wb") as file:', 'with open(os.open(temporary, os.O_WRONLY | os.O_CREAT, 0o600), "wb") as file:'),
    ),
    "test_resume.py::test_a_diverging_run_saves_nothing_that_is_not_finite": (
        (OPTIMISER, "if not torch.isfinite(norm) or not torch.isfinite(total):", "if False:"),
    ),
    "test_resume.py::test_the_levels_name_their_batches_too": (
        (OPTIMISER, "batch: {batch()})", "batch: unnamed)"),
    ),
    "test_checkpoints.py::test_what_is_not_finite_is_neither_written_nor_read": (
        (CHECKPOINTS, 'raise DataError(f"checkpoint {path}: tensor \'{name}\' is not finite")', "pass"),
    ),
    "test_datasets.py::test_what_is_not_finite_is_neither_written_nor_read": (
        (DATASET, "raise DataError(f\"{path}: '{bad}' holds NaN or an infinity\")", "pass"),
    ),
    "test_collecting.py::test_a_simulation_that_diverges_is_a_numerical_failure": (
        (DATASET, "row, index, *_ = np.argwhere(~np.isfinite(tensors[bad]))[0]", "raise DataError(bad)"),
    ),
    "test_bad_input.py::test_numbers_are_finite_and_not_negative": (
        ("cli/flags.py", "return msgspec.convert(value, kind)", "return value"),
    ),
    "test_security.py::test_nothing_read_is_executed": (
        (SEALS, "import hashlib\n", "import hashlib\nimport pickle\n"),
    ),
    "test_zoo.py::test_names_never_lead_out_of_the_zoo": (
        (ZOO, "path = zoo_directory() / text if text in models else Path(name_or_path)", "path = zoo_directory() / text"),
    ),
    "test_datasets.py::test_a_manifest_that_lies_is_refused": (
        (DATASET, 'msgspec.Meta(pattern=rf"\\A{SHARD_NAME.pattern}\\Z")', "msgspec.Meta()"),
    ),
    "test_executors.py::test_a_log_that_lies_is_not_believed": (
        (SHARDS, "if not NAME.fullmatch(name) or not path.is_file():", "if not path.is_file():"),
    ),
    "test_races.py::test_nothing_is_written_to_where_links_lead": (
        (FILES, "flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW", "flags = os.O_RDWR | os.O_CREAT"),
    ),
    "test_fuzz.py::test_an_architecture_is_not_built_before_its_tensors_are_seen": (
        (MODEL, "        with torch.device(\"meta\"):\n            planned", "        with torch.device(\"cpu\"):\n            planned"),
        (MODEL, "if isinstance(value, int) and value > largest:", "if False:"),
    ),
    "test_datasets.py::test_a_shard_larger_than_its_tensors_is_not_even_read": (
        (DATASET, "data = files.read_bytes(path, limit=limit_bytes)", "data = files.read_bytes(path)"),
    ),
    "test_collecting.py::test_more_than_a_manifest_can_list_is_refused_at_once": (
        (COLLECT, "    if total > most:", "    if False:"),
    ),
    # 18, 19: processes
    "test_executors.py::test_a_dataset_is_the_same_from_any_number_of_workers_and_from_a_cluster": (
        (COLLECT, "return [log.done[shard.name] for shard in shards]", "return list(log.done.values())"),
    ),
    "test_executors.py::test_a_sweep_is_the_same_from_any_number_of_workers_and_from_a_cluster": (
        ("core/evaluation/simulator.py", "Block(method, tuple(points), start, stop, reactive)", "Block(method, tuple(points), start, max(stop - 1, start + 1), reactive)"),
    ),
    "test_resume.py::test_a_run_keeps_its_number_of_threads": (
        (PROGRESS, "torch.set_num_threads(saved.threads)", "pass"),
    ),
    "test_executors.py::test_workers_must_be_there_and_compute_the_same": (
        (EXECUTORS, "        if differing:", "        if False:"),
    ),
    "test_resume.py::test_a_real_process_saves_and_says_how_to_go_on": (
        (INTERRUPTS, "        if self._inside and self._signal is None:", "        if False:"),
    ),
    "test_races.py::test_ctrl_c_leaves_no_process_behind_and_the_command_goes_on": (
        (EXECUTORS, "    for number in SIGNALS:\n        signal.signal(number, signal.SIG_IGN)\n", ""),
        (EXECUTORS, "    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)", "    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())"),
    ),
    "test_evaluate.py::test_an_interrupt_ends_the_workers_at_once": (
        (EXECUTORS, "                process.kill()\n            raise\n        finally:", "                pass\n            raise\n        finally:"),
    ),
    "test_survival.py::test_an_interruption_loses_no_curve_that_was_measured": (
        ("stages/survive.py", "for job in jobs if _key(*job) not in kept]", "for job in jobs]"),
    ),
    "test_evaluate.py::test_workers_end_with_a_killed_parent": (
        (EXECUTORS, "    threading.Thread(target=end, daemon=True).start()", "    end"),
    ),
    "test_races.py::test_the_caller_s_own_processes_survive_ours": (
        (EXECUTORS, "for process in set(multiprocessing.active_children()) - others:", "for process in set(multiprocessing.active_children()):"),
    ),
    "test_executors.py::test_a_dead_worker_is_one_line": (
        (EXECUTORS, 'if isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker":', "if False:"),
    ),
    "test_races.py::test_a_worker_that_dies_with_the_lock_of_progress_stops_nobody": (
        (WORKERS, "lambda: counter.value)) as workers:", "lambda: done.value)) as workers:"),
    ),
    "test_executors.py::test_a_scheduler_that_ends_is_one_line": (
        (EXECUTORS, '            if client.status == "running":\n                raise\n', "            raise\n"),
    ),
    "test_ranks.py::test_a_killed_process_ends_the_others_and_the_run_goes_on": (
        (RANKS, "    except RuntimeError:\n        raise torchrun.ContactLost(", "    except ZeroDivisionError:\n        raise torchrun.ContactLost("),
    ),
    "test_ranks.py::test_processes_must_see_the_same": (
        ("stages/training.py", "[:15], 16)))) > 1:", "[:15], 16)))) > 9:"),
    ),
    "test_ranks.py::test_all_stop_after_the_same_step_and_one_process_can_go_on": (
        (PROGRESS, "stop = any(self._ranks.gather(stopped()))", "stop = stopped()"),
    ),
    # 20 – 24: texts, locks, versions, dependencies, the zoo
    "test_security.py::test_a_model_of_any_name_prints_as_text": (
        (SCREEN, 'one if one.isprintable() or one == "\\u00a0" else one.encode("unicode_escape").decode()', "one"),
    ),
    "test_report.py::test_names_cannot_smuggle_markup_in": (
        ("stages/report.py", "autoescape=True,", "autoescape=False,"),
    ),
    "test_races.py::test_what_stands_in_a_foreign_lock_is_not_repeated": (
        (FILES, 'found = _HOLDER.fullmatch(file.read(100) or b"")', 'found = re.match(b"(?s).*", file.read(100) or b"")'),
    ),
    "test_runs.py::test_a_second_process_is_locked_out": (
        (FILES, "            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)", "            pass"),
    ),
    "test_races.py::test_a_refusal_says_who_is_working_there": (
        (FILES, 'file.write(f"process {os.getpid()} on {platform.node()}".encode())', "pass"),
    ),
    "test_races.py::test_evaluations_that_share_a_file_of_curves_lose_none": (
        (FILES, "            fcntl.flock(handle, fcntl.LOCK_EX)", "            pass"),
    ),
    "test_schemas.py::test_newer_files_are_refused_with_what_to_do": (
        (FILES, "if type(found) is int and found > newest:", "if False:"),
    ),
    "test_schemas.py::test_a_fixture_for_every_version": (
        (RUNS, "SCHEMA = 3  # of environment.json", "SCHEMA = 4  # of environment.json"),
    ),
    "test_runs.py::test_what_an_older_version_had_not_is_as_its_preset_says": (
        (RUNS, "before |= {key: defaults[key] for key in later if key in defaults}", "pass"),
    ),
    "test_collecting.py::test_a_collection_of_an_older_version_goes_on": (
        (RUNS, "before |= {key: defaults[key] for key in later if key in defaults}", "pass"),
        (SHARDS, "SCHEMA = 2  # of its first line", "SCHEMA = 3  # of its first line"),
    ),
    "test_resume.py::test_a_state_whose_metrics_were_in_the_header_goes_on": (
        (PROGRESS, 'rows = saved.metrics or ""', 'rows = ""'),
    ),
    "test_security.py::test_dependencies_are_few_and_bounded": (
        ("../pyproject.toml", '    "typer>=0.27,<0.30",\n]', '    "typer>=0.27,<0.30",\n    "requests",\n]'),
    ),
    "test_security.py::test_the_guard_sees_it": (
        ("../tests/cli/test_security.py", 'CALLS = {"eval", "exec", "compile", "__import__"}', 'CALLS = {"compile"}'),
    ),
    "test_zoo_numbers.py::test_a_few_devices_score_as_on_the_card": (
        ("core/plants/cartpole/plant.py", "SCORE_THETA_RAD = 0.05", "SCORE_THETA_RAD = 0.02"),
    ),
    "test_zoo.py::test_verify_says_which_curves_are_not_those_of_the_defaults": (
        (CURVES, "    if of != digest.as_dict():\n        return {}\n", ""),
    ),
    # 25 – 28: seals, settings
    "test_seals.py::test_one_digit_of_curves_is_noticed_by_verify_and_scale": NO_SEAL,
    "test_seals.py::test_curves_of_the_present_schema_without_a_seal_are_refused": (
        (SEALS, 'former = SEAL not in document and document["schema"] == schema - 1', "former = SEAL not in document"),
        (SEALS, "check_schema(document[\"schema\"], schema - former, str(where))", "pass"),
    ),
    "test_seals.py::test_curves_without_a_seal_are_read_where_they_are_named_and_never_a_cache": (
        (CURVES, "if seals.SEAL not in document and not named:", "if False:"),
    ),
    "test_seals.py::test_impossible_values_are_refused_under_the_right_seal": (
        (CURVES, "if not (low <= high and low - slack <= value <= high + slack):", "if False:"),
    ),
    "test_seals.py::test_results_and_tables_are_sealed": (
        (RUNS, "if tables[name] != now.get(name):", "if False:"),
    ),
    "test_seals.py::test_verify_checks_the_run_around_a_model": (
        (ZOO, "        runs.read_result(path.parent)", "        pass"),
    ),
    "test_seals.py::test_no_mutation_changes_what_is_read": NO_SEAL,
    "test_races.py::test_children_import_nothing_from_the_current_directory": (
        (EXECUTORS, 'safe, os.environ["PYTHONSAFEPATH"] = os.environ.get("PYTHONSAFEPATH"), "1"', 'safe, os.environ["PYTHONSAFEPATH"] = os.environ.get("PYTHONSAFEPATH"), ""'),
    ),
    "test_seals.py::test_settings_that_were_changed_are_named": (
        (RUNS, 'if recorded["schema"] == SCHEMA and (changed := differences(recorded["settings"], found)):', "if changed := []:"),
    ),
    "test_runs.py::test_a_run_with_other_flags_is_not_the_one_that_is_asked_for": (
        (RUNS, "return files_of | flags", "return files_of"),
    ),
    "test_resume.py::test_a_state_goes_on_under_its_own_settings_only": (
        (PROGRESS, "if changed := differences(before, settings):", "if changed := []:"),
    ),
    "test_radio_input.py::test_what_the_law_would_not_read_is_refused_from_wherever_it_comes": (
        (CHECKS, "if laws and radio.law not in laws and not moves:", "if False:"),
    ),
    "test_api.py::test_a_simulated_cell_refuses_settings_that_it_does_not_read": (
        (CHECKS, 'if key not in UPLINK and (key, value) != ("radio.law", "scheduled"):', "if False:"),
    ),
    "test_radio_input.py::test_settings_of_a_cell_do_not_concern_other_stages": (
        (CHECKS, "    check_methods(settings.methods)\n    gaps", "    check_methods(settings.methods)\n    check_cell(settings.radio)\n    gaps"),
    ),
    # 29 – 32: bounds, exports, targets, NaN
    "test_hall.py::test_who_is_pushed_out_to_the_bound_stands_on_it": (
        ("core/radio/factory_hall.py", "np.asarray(np.maximum(np.hypot(place[:, 0], place[:, 1]), CLOSEST_M))", "np.asarray(np.hypot(place[:, 0], place[:, 1]))"),
    ),
    "test_channel.py::test_what_rounding_puts_beside_a_bound_is_on_it": (
        (CHANNEL, "ROUNDING = 1e-12", "ROUNDING = 0.0"),
    ),
    "test_capacity.py::test_a_packet_that_fills_its_slot_exactly_is_on_time": (
        (CHANNEL, "ROUNDING = 1e-12", "ROUNDING = 0.0"),
    ),
    "test_data_tools.py::test_hdf5_is_of_a_layout_that_all_libraries_read_and_append_to": (
        ("core/datasets/exports.py", 'libver=("v110", "v110")', 'libver="latest"'),
    ),
    "test_files.py::test_special_files_are_refused_and_stay": (
        (FILES, "if kind := kinds.get(stat.S_IFMT(path.lstat().st_mode)):", "if kind := None:"),
    ),
    "test_files.py::test_links_that_a_person_names_are_followed": (
        (FILES, "path = Path(os.path.realpath(path)) if path.is_symlink() else path", "pass"),
    ),
    "test_data_tools.py::test_an_export_follows_links_and_refuses_pipes": (
        (FILES, "path = Path(os.path.realpath(path)) if path.is_symlink() else path", "pass"),
    ),
    "test_not_finite.py::test_a_camera_draws_no_garbage": NO_FINITE,
    "test_not_finite.py::test_a_simulation_goes_on_as_if_nothing_had_been_asked": NO_FINITE,
    "test_not_finite.py::test_one_cart_pole_stays_as_it_was": NO_FINITE,
    "test_not_finite.py::test_equations_and_teachers_answer_no_garbage": NO_FINITE,
    "test_not_finite.py::test_a_model_answers_no_garbage": NO_FINITE,
    # 33: streams
    "test_streams.py::test_results_that_do_not_get_out_are_one_line_and_74": (
        (APP, "if out is None or out.lost is None or code != 0:", "if True:"),
    ),
    "test_streams.py::test_an_error_keeps_its_code_where_it_cannot_be_told": (
        (STREAMS, "        except OSError as error:\n            self.lost = error", "        except ZeroDivisionError as error:\n            self.lost = error"),
    ),
    "test_streams.py::test_a_closed_stream_is_the_null_device": (
        (STREAMS, "    is_file = old is None or old.closed\n", "    is_file = False\n"),
    ),
    "test_streams.py::test_streams_that_are_none_are_the_null_device": (
        (STREAMS, "    is_file = old is None or old.closed\n", "    is_file = False\n"),
    ),
    "test_streams.py::test_no_file_of_ours_is_what_a_closed_stream_was": (
        (STREAMS, "    _occupy()\n    before", "    before"),
    ),
    "test_streams.py::test_a_run_survives_a_full_log_disk": (
        (STREAMS, "        except OSError as error:\n            self.lost = error", "        except ZeroDivisionError as error:\n            self.lost = error"),
    ),
    # 34: launchers
    "test_launcher.py::test_a_variable_that_is_wrong_is_named": (
        ("compute/torchrun.py", "    if number < least or (most is not None and number > most):", "    if False:"),
    ),
    "test_launcher.py::test_a_peer_that_never_comes_is_waited_for_aloud_and_interruptibly": (
        (RANKS, "        if waited_s > QUIET_S and not said:", "        if False:"),
    ),
    "test_launcher.py::test_a_port_that_is_taken_is_named": (
        (RANKS, "            if serves:\n                raise UsageError(", "            if False:\n                raise UsageError("),
        (RANKS, "TIMEOUT = datetime.timedelta(minutes=30)", "TIMEOUT = datetime.timedelta(seconds=5)"),
    ),
    # 35 – 38: directories, memory, file systems, paths
    "test_odd_disks.py::test_a_run_whose_directory_was_moved_writes_into_no_other": NOT_HELD,
    "test_odd_disks.py::test_a_deleted_directory_is_not_made_again": NOT_HELD,
    "test_odd_disks.py::test_two_collections_one_in_the_place_of_the_other_do_not_mix": NOT_HELD,
    "test_odd_disks.py::test_a_worker_writes_into_the_directory_that_was_locked": (
        (FILES, "    if node != platform.node():", "    if True:"),
    ),
    "test_memory.py::test_running_out_of_memory_is_no_error_to_report": (
        (APP, "    if memory.ran_out(error):", "    if False:"),
    ),
    "test_memory.py::test_sizes_beyond_the_memory_are_refused_before_any_work": (
        ("compute/memory.py", 'f"{what} takes about', 'f"{what} took about'),
        ("compute/memory.py", "of memory; \"", "of room; \""),
    ),
    "test_memory.py::test_sizes_have_upper_bounds": (
        ("config/schema.py", "MOST = 10**9", "MOST = 10**18"),
    ),
    "test_memory.py::test_a_training_beyond_the_memory_is_refused": MEMORY,
    "test_memory.py::test_an_export_beyond_the_memory_is_refused": MEMORY,
    "test_memory.py::test_an_export_takes_no_more_memory_for_more_trajectories": (
        ("core/datasets/exports.py", "for number, block in enumerate(blocks):", "for number, block in enumerate(list(blocks)):"),
    ),
    "test_odd_disks.py::test_a_disk_without_locks_is_said_and_used": (
        (FILES, "            if error.errno not in _UNSUPPORTED:\n                file.close()", "            if True:\n                file.close()"),
    ),
    "test_odd_disks.py::test_a_disk_that_cannot_flush_directories_is_used": (
        (FILES, "        if error.errno not in _UNSUPPORTED:\n            raise", "        if True:\n            raise"),
    ),
    "test_odd_disks.py::test_without_semaphores_there_is_one_process": (
        (EXECUTORS, "    except (OSError, ImportError, NotImplementedError) as error:\n        raise NumericalError(", "    except ZeroDivisionError as error:\n        raise NumericalError("),
    ),
    "test_paths.py::test_any_bytes_are_a_path_wherever_one_is_written": (
        (FILES, 'return text.encode(errors="backslashreplace")', "return text.encode()"),
    ),
    "test_paths.py::test_a_locale_of_few_characters_is_enough": (
        (FILES, 'return text.encode(errors="backslashreplace")', "return text.encode()"),
        (STREAMS, 'errors="replace",\n        line_buffering', 'errors="strict",\n        line_buffering'),
    ),
    # 39 – 43: hints, records, data, schedulers, dry runs
    "test_hints.py::test_a_hint_that_cannot_be_followed_is_noticed": (
        ("../tests/command_line.py", 'pytest.fail(f"hint', 'str(f"hint'),
    ),
    "test_foreign_records.py::test_a_result_that_is_none_of_its_stage_is_refused": (
        ("stages/results.py", "        raise damaged(directory, stage, reason)\n", "        pass\n"),
    ),
    "test_foreign_records.py::test_surroundings_that_are_none_are_refused": (
        (RUNS, "        msgspec.convert(recorded, _Environment)", "        pass"),
    ),
    "test_foreign_records.py::test_a_digit_changed_in_any_record_of_a_finished_run_is_noticed": (
        (RUNS, "records = (directory / CONFIG, directory / ENVIRONMENT)", "records = ()"),
    ),
    "test_foreign_records.py::test_one_damaged_shard_does_not_hide_the_others": (
        ("stages/data.py", "            flaws = list(data.flaws())", "            flaws = []"),
    ),
    "test_degenerate.py::test_data_in_which_nothing_moves_are_refused_at_the_start": (
        ("stages/training.py", "        if split.states.size and (split.states == split.states[0, 0]).all():", "        if False:"),
    ),
    "test_degenerate.py::test_movements_that_no_camera_sees_are_refused_before_training": (
        ("stages/training.py", "            if (split.frames == split.frames[0, 0]).all():", "            if False:"),
    ),
    "test_degenerate.py::test_what_is_undefined_is_none": (
        ("core/networks/health.py", "    varies = (truth != truth[0]).any(0)", "    varies = torch.ones(truth.shape[1])"),
    ),
    "test_strange_clusters.py::test_a_listener_that_is_no_scheduler_is_soon_refused": (
        (EXECUTORS, "                check_answer(address)", "                pass"),
    ),
    "test_strange_clusters.py::test_a_file_that_no_scheduler_wrote_is_refused": (
        (EXECUTORS, "    if not Path(where).exists():\n        if", "    return where\n    if True:\n        if"),
    ),
    "test_small_things.py::test_a_dry_run_refuses_what_the_command_would": (
        ("stages/view.py", "    check(settings, screen, out=out, devices=devices, every=every, fps=fps, live=live)\n    models", "    models"),
    ),
    "test_small_things.py::test_sizes_of_conditions_are_those_of_things": (
        ("config/schema.py", "pole_length: Annotated[float, Meta(ge=0.01, le=100)]", "pole_length: Positive"),
    ),
    # 44 – 48: arrays, copies, smoke, quantisers, signals
    "test_outside.py::test_any_memory_layout_is_read_right": (
        ("core/networks/outside.py", 'torch.from_numpy(np.require(array, requirements=["C", "W"]))', "torch.from_numpy(array)"),
    ),
    "test_outside.py::test_an_empty_batch_has_no_embeddings": (
        (MODEL, "range(0, max(len(frames), 1), together)", "range(0, len(frames), together)"),
    ),
    "test_outside.py::test_other_pictures_are_refused_with_what_they_are": (
        ("core/networks/outside.py", "    if array.dtype != np.uint8 or array.shape[1:] != shape or", "    if False and"),
    ),
    "test_outside.py::test_other_embeddings_are_refused": (
        ("core/networks/outside.py", "    if not z.is_floating_point() or z.ndim < 2 or z.shape[-1] != width:", "    if False:"),
    ),
    "test_outside.py::test_other_states_are_refused_by_teachers_and_cart_poles": (
        ("core/plants/cartpole/teacher.py", "        if states.shape[-1:] != (4,):", "        if False:"),
    ),
    "test_outside.py::test_the_radio_refuses_what_is_no_array_or_does_not_go_together": (
        (CHANNEL, "        except (TypeError, ValueError) as error:\n            raise ArrayError", "        except ZeroDivisionError as error:\n            raise ArrayError"),
    ),
    "test_answers.py::test_a_plant_that_answers_wrong_is_named": (
        ("core/plants/system.py", "            look_at(cls)", "            pass"),
    ),
    "test_answers.py::test_what_a_plant_does_to_its_arrays_is_its_own": (
        ("core/plants/answers.py", "return given.copy() if isinstance(given, np.ndarray) else given", "return given"),
    ),
    "test_import.py::test_columns_are_found_by_their_names_in_every_table": (
        ("core/datasets/importing/folder.py", "alike = tables[0][1].chosen if tables else chosen", "alike = chosen"),
    ),
    "test_gym_copies.py::test_an_environment_is_made_again_from_its_spec": (
        ("gym.py", "        gymnasium.utils.RecordConstructorArgs.__init__(self, **kept)", "        pass"),
    ),
    "test_gym_copies.py::test_a_copy_goes_on_where_the_original_is": (
        ("core/plants/cartpole/simulation.py", "        self.__init__(**made_of)  # type: ignore[misc]\n        self.states = states", "        self.__init__(**made_of)  # type: ignore[misc]"),
    ),
    "test_smoke.py::test_a_smoke_model_is_nobody_s_default": (
        (RUNS, "    if preset != SMOKE:\n        finished", "    if False:\n        finished"),
    ),
    "test_runs.py::test_newest_run_is_finished_and_fits": (
        (RUNS, "            return float(time_s)", "            pass"),
    ),
    "test_integers.py::test_no_value_is_off_by_more_than_half_a_step": (
        ("core/control/codecs/integers.py", "(scale > 0) & (largest > scale.float() * (1 + 0.5 / self._top))", "scale < 0"),
    ),
    "test_interrupts.py::test_a_signal_is_one_line_and_a_second_one_ends_at_once": (
        (APP, "        if ends:\n            end_at_once()\n", ""),
    ),
    "test_interrupts.py::test_nohup_is_respected": (
        (INTERRUPTS, "            if signal.getsignal(number) != signal.SIG_IGN:\n                handlers", "            if True:\n                handlers"),
    ),
    "test_bad_input.py::test_a_read_only_directory_is_refused_to_everybody": (
        (FILES, 'raise StorageError(f"cannot write {path}: {reason}", hint=hint) from None', "raise"),
    ),
    "test_small_things.py::test_a_large_foreign_file_is_not_read_beyond_its_header": (
        (CHECKPOINTS, "                arrays.check_header(path)", "                pass"),
    ),
    "test_small_things.py::test_figures_of_two_runs_of_a_stage_have_two_names": (
        ("stages/report.py", 'name = stage if alone else f"{stage}-{directory.resolve().name}"', "name = stage"),
    ),
    "test_small_things.py::test_a_notebook_s_backend_does_not_matter": (
        ("output/figures.py", '_wanted = os.environ.pop("MPLBACKEND", None)', "_wanted = None"),
    ),
    "test_small_things.py::test_a_hall_that_covers_few_says_so": (
        ("stages/scale_by_simulation.py", "        if covered:\n            ends", "        if False:\n            ends"),
    ),
    "test_familiarity.py::test_garbage_is_flagged_and_ordinary_packets_are_not": (
        ("core/control/familiarity.py", "flagged = self._familiarity.strange(packets) | same", "flagged = same"),
    ),
    "test_familiarity.py::test_a_camera_that_shows_the_same_for_long_is_flagged": (
        ("core/control/familiarity.py", "flagged = self._familiarity.strange(packets) | same", "flagged = self._familiarity.strange(packets)"),
    ),
    "test_familiarity.py::test_flagged_packets_are_kept_back_but_no_more_than_the_limit_in_a_row": (
        ("core/control/familiarity.py", " | (self._in_row[rows] > self._limit)", ""),
    ),
    "test_stress.py::test_what_is_no_condition_is_refused": (
        ("core/plants/stress.py", "if not self.low <= severity <= self.high or", "if False and"),
    ),
    "test_frames_apart.py::test_frames_that_a_device_has_forgotten_are_refused": (
        ("config/checks.py", "if (back := encoder.look[0]) > FARTHEST_BACK:", "back = 0\n    if False:"),
    ),
    "test_sensor.py::test_what_a_camera_cannot_have_is_refused": (
        ("core/plants/sensor.py", "    if exposure_ms > step_ms * (1 + 1e-9):", "    if False:"),
    ),
    "test_alignment.py::test_what_is_left_decides": (
        ("core/datasets/importing/alignment.py", " and stated < ALIKE * fits", ""),
    ),
    "test_import.py::test_tables_of_other_programs_are_read_or_refused_by_what_is_in_them": (
        ("core/datasets/importing/columns.py", "if name and header.count(name) > 1:", "if False:"),
    ),
    # 50: the wire
    "test_controller.py::test_another_key_another_model_another_version_and_no_place": (
        (CONTROLLER, "if not auth.is_tagged(self._key, data):", "if False:"),
    ),
    "test_controller.py::test_a_hundred_thousand_bad_datagrams_change_nothing": (
        (CONTROLLER, "if one is not None and auth.is_tagged(one.key, data):", "if one is not None:"),
    ),
    "test_controller.py::test_old_doubled_and_foreign_datagrams_change_nothing": (
        (CONTROLLER, 'if verdict != "new" or message.capture <= session.newest:', "if False:"),
    ),
    "test_controller.py::test_a_recorded_session_proves_nothing_to_a_new_server": (
        (CONTROLLER, "if nonce in self._nonces:", "if False:"),
    ),
    "test_controller.py::test_recorded_hellos_do_not_end_a_handshake_under_way": (
        (CONTROLLER, "deque(maxlen=protocol.TRIES)", "deque(maxlen=1)"),
    ),
    "test_controller.py::test_silent_devices_are_forgotten_and_memory_is_bounded": (
        (CONTROLLER, "while len(self._pending) > PENDING:", "while False:"),
    ),
    "test_controller.py::test_one_device_cannot_take_more_than_its_allowance": (
        (CONTROLLER, "if not session.allowance.take(now_s):  # last", "if False:  # last"),
    ),
    "test_controller.py::test_who_has_no_key_spends_no_device_s_allowance": (
        (CONTROLLER, "        session = self._session_of(device, data)\n", "        if device in self.sessions and not self.sessions[device].allowance.take(now_s):\n            return []\n        session = self._session_of(device, data)\n"),
    ),
    "test_controller.py::test_who_has_no_key_is_of_no_version": (
        (CONTROLLER, "if not self._admit(data, self._greeting_others, now_s):", "if not self._greeting.take(now_s):"),
    ),
    "test_controller.py::test_an_older_server_is_told_from_a_newer_one": (
        (DEVICE, "if ours and auth.is_tagged(self._key, data):", "if ours:"),
    ),
    "test_datagrams.py::test_a_step_that_no_session_has_is_refused": (
        (PROTOCOL, "if step >= MOST_STEPS:", "if False:"),
    ),
    "test_controller.py::test_a_session_whose_numbers_end_ends_alone": (
        (CONTROLLER, "if max(session.planned, session.counter) < protocol.MOST_STEPS:", "if True:"),
    ),
    "test_drive.py::test_steps_beyond_those_of_a_session_begin_another_one": (
        (DRIVE, "if k == protocol.MOST_STEPS:", "if False:"),
    ),
    "test_controller.py::test_a_device_connects_over_a_long_round_trip": (
        (DEVICE, "min(max(2 * self._wait_s, first_s), longest_s)", "first_s"),
    ),
    "test_drive.py::test_a_device_that_has_no_place_drives_itself_and_goes_on_asking": (
        (DRIVE, "if not isinstance(error, Unavailable) or not self._device.has_actor:", "if True:"),
    ),
    "test_drive.py::test_a_refusal_that_cannot_pass_or_leaves_nobody_to_drive_ends": (
        (DRIVE, "if not isinstance(error, Unavailable) or not self._device.has_actor:", "if False:"),
    ),
    "test_controller.py::test_silence_holds_then_the_actor_on_the_device_drives": (
        (DEVICE, "elif self.silent < self.watchdog_steps:", "elif True:"),
    ),
    "test_controller.py::test_forces_are_clipped_to_the_limit": (
        (DEVICE, "np.clip(planned, -limit_n, limit_n)", "planned"),
    ),
}  # fmt: skip


def rows() -> list[tuple[str, str]]:
    """Return the fault and the test of each row of the table, in its order."""
    text = TABLE.read_text(encoding="utf-8")
    return re.findall(r"^\| \d+ \| (.+?) \| (test_\w+\.py::test_\w+) \|$", text, flags=re.M)


def stale(test: str) -> str | None:
    """Return what keeps the change for a test from being made, if anything."""
    if test not in GUARDS:
        return "no change takes its guard away"
    for file, old, new in GUARDS[test]:
        text = (ROOT / "hjepa_cli" / file).read_text(encoding="utf-8")
        if text.count(old) != 1 or old == new:
            return f"{file} has this {text.count(old)} times: {old!r}"
    return None


def tracked() -> Iterator[Path]:
    """Yield the files of the repository, below its root."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
    )
    yield from map(Path, filter(None, listed.stdout.split("\0")))


def survives(test: str, files: Iterable[Path]) -> bool:
    """Return whether a test passes without its guard, in a copy of the repository.

    Raises:
        ValueError: it ran nothing, or could not run.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for file in files:
            (copy / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / file, copy / file)
        for file, old, new in GUARDS[test]:
            path = copy / "hjepa_cli" / file
            path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
        name, _, function = test.partition("::")
        (where,) = copy.joinpath("tests").rglob(name)
        environment = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "pytest", "-x", f"{where}::{function}"]
        try:
            done = subprocess.run(
                command,
                cwd=copy,
                env=environment,
                capture_output=True,
                text=True,
                timeout=LONGEST_S,
            )
        except subprocess.TimeoutExpired:
            return False  # it hangs without its guard
    if done.returncode not in (0, 1):
        raise ValueError(f"pytest ended with {done.returncode}: {done.stdout[-2000:]}")
    return done.returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="rows whose test has this in its name")
    parser.add_argument("--jobs", type=int, default=1, help="rows at a time")
    options = parser.parse_args()
    tests = list(dict.fromkeys(test for _, test in rows() if options.only in test))
    if old := {test: why for test in tests if (why := stale(test))}:
        for test, why in old.items():
            print(f"{test}: {why}", file=sys.stderr)
        return 1
    files, survivors = list(tracked()), []

    def judge(test: str) -> tuple[str, bool, float]:
        began_s = time.monotonic()
        return test, survives(test, files), time.monotonic() - began_s

    with ThreadPoolExecutor(options.jobs) as pool:
        for test, survived, seconds in pool.map(judge, tests):
            survivors += [test] if survived else []
            verdict = "SURVIVES" if survived else "fails without its guard"
            print(f"{verdict:24} {seconds:5.0f} s  {test}", flush=True)
    print(f"{len(tests) - len(survivors)} of {len(tests)} tests fail without their guards")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
