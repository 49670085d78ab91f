"""What attacks on the cell have come to light, and the test of each that failed before it was mended.

The numbers are those of the attack of commit bd720d7 (S1: out of service or a wrong pose; S2: starved or blind; S3 and
S4: smaller), then what bug reports and real files have shown.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
_SERVER, _WORKERS = "inference/server", "inference/server/worker/test_workers.py"

# Finding: file of its tests and their names.
FINDINGS: dict[str, list[tuple[str, str]]] = {
    "S1-1 two points at +-FLT_MAX end the server for ever": [
        ("geometry/test_sanitized.py", "test_c_files_end_stay_in_their_memory_and_equal_their_references"),
        ("inference/test_measured_points.py", "test_a_few_strays_are_left_out"),
        (_WORKERS, "test_a_job_that_does_not_end_is_killed_and_the_spare_answers"),
        ("attack/test_over_http.py", "test_no_body_keeps_the_next_one_waiting"),
    ],
    "S1-2 absurd points give absurd poses, first in the list": [
        ("inference/test_estimator.py", "test_strays_change_nothing_but_the_warning"),
        ("inference/test_estimator.py", "test_a_pose_outside_the_scan_is_left_out_and_counted"),
    ],
    "S1-3 a bundle of several parts loses which part a pose is": [
        (f"{_SERVER}/protocol/test_parts.py", "test_every_interface_says_which_part_a_pose_is"),
        ("inference/client/test_ros.py", "test_every_part_has_its_own_box_and_a_part_without_is_refused"),
    ],
    "S1-4 small files end the server by memory": [
        ("inference/scans/test_array_bytes.py", "test_packings_that_unpack_without_limit_are_not_unpacked"),
        ("inference/scans/test_depth_files.py", "test_a_second_header_is_refused_before_anything_is_decoded"),
        (_WORKERS, "test_a_body_that_takes_too_much_memory_is_refused_and_nothing_else"),
        ("attack/test_over_http.py", "test_no_body_keeps_the_next_one_waiting"),
    ],
    "S1-5 255 silent connections keep everybody out": [
        (f"{_SERVER}/network/test_book.py", "test_silent_connections_keep_nobody_out"),
        (f"{_SERVER}/network/test_book.py", "test_health_has_places_of_its_own"),
        (f"{_SERVER}/network/test_listening.py", "test_without_a_file_handle_it_waits_says_so_once_and_goes_on"),
    ],
    "S2-1 an upload without a token starves the event loop": [
        (f"{_SERVER}/network/test_connection.py", "test_a_refused_upload_is_not_parsed_on"),
        (f"{_SERVER}/network/test_connection.py", "test_an_accepted_client_s_small_chunks_are_refused"),
    ],
    "S2-2 nothing notices a stuck estimator": [
        (_WORKERS, "test_a_stuck_worker_without_a_spare_is_not_available"),
        (_WORKERS, "test_a_job_that_hangs_keeps_the_next_ones_waiting_for_a_second"),
    ],
    "S2-3 a self-test that does not end blocks all later updates": [
        (_WORKERS, "test_a_self_test_that_does_not_end_refuses_the_bundle"),
        ("attack/test_over_http.py", "test_an_update_that_never_ends_is_refused_and_the_next_one_taken"),
    ],
    "S2-4 parsing knows no deadline": [
        ("inference/scans/test_array_bytes.py", "test_a_directory_is_measured_before_it_is_read"),
        ("inference/scans/test_damaged_files.py", "test_damaged_files_give_an_array_or_one_sentence"),
        ("attack/test_over_http.py", "test_no_body_keeps_the_next_one_waiting"),
    ],
    "S2-5 scans as sensors write them are refused": [
        ("inference/test_measured_points.py", "test_the_limit_counts_measured_points"),
        ("inference/test_measured_points.py", "test_missing_measurements_are_counted_and_left_out"),
    ],
    "S3-1 damaged LZMA data are an internal error": [
        ("inference/scans/test_array_bytes.py", "test_packings_that_unpack_without_limit_are_not_unpacked"),
    ],
    "S3-2 the normals read behind their memory": [
        ("geometry/test_sanitized.py", "test_c_files_end_stay_in_their_memory_and_equal_their_references"),
    ],
    "S3-3 a graph may name data outside its bundle": [
        ("inference/bundles/test_external_data.py", "test_a_bundle_with_a_tensor_outside_is_refused"),
    ],
    "S3-4 a user without a home": [
        ("inference/test_home_folder.py", "test_a_user_without_a_home_gets_a_sentence"),
        ("inference/test_home_folder.py", "test_compiled_code_is_looked_for_where_nobody_else_writes"),
    ],
    "S3-5 a log that nobody reads stops the server": [
        (f"{_SERVER}/test_log_writer.py", "test_a_server_whose_log_nobody_reads_goes_on_and_ends"),
    ],
    "S3-6 the health check knows neither TLS nor ports; tokens in clear": [
        (f"{_SERVER}/test_health.py", "test_the_running_server_is_found_whatever_its_port_and_tls"),
        (f"{_SERVER}/test_serve.py", "test_tokens_in_clear_are_warned_of_once"),
    ],
    "S3-7 the systemd unit cannot be enabled and is exposed": [
        ("docker/test_service.py", "test_systemd_finds_it_closed"),
        ("docker/test_service.py", "test_it_can_be_enabled_and_comes_back"),
    ],
    "S3-8 a place is taken before the body is there": [
        (f"{_SERVER}/test_reception.py", "test_stalled_bodies_take_no_places"),
        (f"{_SERVER}/test_reception.py", "test_the_oldest_gives_way_when_too_many_come"),
    ],
    "S4-1 a registry that drips holds the cell's thread": [
        ("inference/fetching/test_bounded_http.py", "test_a_question_ends_in_its_time"),
        ("inference/fetching/test_bounded_http.py", "test_a_file_ends_in_its_time"),
    ],
    "S4-2 PoseClient's deadline is a socket's": [
        ("inference/client/test_timed_connection.py", "test_nothing_outlasts_the_deadline_by_more_than_a_second"),
        ("inference/client/test_timed_connection.py", "test_chunks_of_a_proxy_are_read"),
    ],
    "S4-3 SIGTERM is swallowed in the moment after the address": [
        (f"{_SERVER}/network/test_listening.py", "test_a_signal_in_the_moment_after_the_address_ends_it_in_order"),
    ],
    "S4-4 the end takes longer than docker waits": [
        (f"{_SERVER}/network/test_listening.py", "test_the_end_takes_less_than_docker_waits"),
        ("docker/test_compose.py", "test_the_cell_has_the_time_to_end_in_order"),
    ],
    "S4-6 a 504 says what was left, a 400 of uvicorn is plain text": [
        (f"{_SERVER}/test_answering.py", "test_the_deadline_stops_the_work_and_frees_the_place"),
        (f"{_SERVER}/network/test_connection.py", "test_what_is_no_http_gets_a_sentence"),
    ],
    "S4-7 whoever is refused starts anew": [
        (_WORKERS, "test_jobs_are_done_in_their_order"),
    ],
    "S4-8 any Host header is accepted": [
        (f"{_SERVER}/test_request_log.py", "test_without_a_token_only_this_machine_s_names_are_answered"),
    ],
    "S4-9 config and stats of Triton's client are 404": [
        (f"{_SERVER}/protocol/test_routes.py", "test_tritons_config_and_statistics_are_true"),
    ],
    "A name of 8 MB is compared with the right one for minutes": [
        ("inference/test_errors.py", "test_a_name_of_any_length_is_compared_at_once"),
    ],
    "A header of 30,000 odd characters leaves a worker counted as stuck": [
        (_WORKERS, "test_a_job_that_cannot_be_sent_costs_nothing"),
        ("attack/test_over_http.py", "test_odd_requests_are_one_sentence_each"),
    ],
    "Workers that are not taken up stay for ever": [
        (f"{_SERVER}/model/test_bundle_loading.py", "test_workers_that_may_not_serve_are_closed"),
    ],
    "A blind sensor is an empty bin": [
        ("inference/test_estimator.py", "test_a_blind_sensor_is_no_empty_bin"),
        ("inference/test_estimator.py", "test_a_scan_that_is_mostly_missing_is_answered_with_a_warning"),
    ],
    "A bin upside down in the cell file reads as empty; a key twice": [
        ("inference/test_cell.py", "test_an_impossible_cell_is_one_sentence"),
        ("inference/test_crop.py", "test_a_bin_whose_opening_does_not_face_the_camera_is_refused"),
    ],
    "One place 40,000 times takes nine seconds of normals": [
        ("geometry/test_pointcloud.py", "test_places_that_are_repeated_take_no_longer"),
    ],
    "An answer's body waits 40 ms for its head to be acknowledged": [
        (f"{_SERVER}/test_serve.py", "test_a_body_does_not_wait_for_its_head_to_be_acknowledged"),
    ],
    "kill of make ui leaves its server": [
        ("tracking/test_server.py", "test_kill_of_the_starter_ends_the_server_and_its_hold_on_the_database"),
    ],
}


@pytest.mark.parametrize("finding", FINDINGS)
def test_every_finding_has_its_tests(finding: str) -> None:
    for file, name in FINDINGS[finding]:
        tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{file}: {name}"
