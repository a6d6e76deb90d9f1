"""Mutants by a reader of the code who has not seen the tests."""

from __future__ import annotations

from .mutant import Mutant

MUTANTS = [
    Mutant(
        "A chunk is half-open: the mask of eq. 2 is 0 at the frame `stop`, not only behind it.",
        "dejavu_torch/maps/templates.py",
        "(frames >= start) & (frames < stop)",
        "(frames >= start) & (frames <= stop)",
        ("tests/maps/test_templates.py::-k half_open or eq_2",),
    ),
    Mutant(
        "A template is the mean of all frames of its phase (eq. 1), also in a chunk so long that it is "
        "summed in several stretches (over 2^22 / phases frames).",
        "dejavu_torch/maps/templates.py",
        "count = count + mask.sum(1, keepdim=True)",
        "count = mask.sum(1, keepdim=True)",
        ("tests/test_behaviour.py::test_templates_of_a_long_chunk_are_means",),
    ),
    Mutant(
        "A trained weight below 0 counts by its size: freezing a template map turns its sign and "
        "changes no score.",
        "dejavu_torch/maps/template_map.py",
        "self.weights = self.weights.abs()",
        "self.weights = self.weights.clamp(min=0)",
        ("tests/maps/test_template_map.py::test_trained_weights_freeze_to_none_below_0",),
    ),
    Mutant(
        "A place whose rebuilt descriptor has next to no length (1e-6 of the map's RMS) has cosine 0, "
        "so score 1, with every query.",
        "dejavu_torch/maps/spectral_map.py",
        "return norms * ~(norms <= least)",
        "return norms",
        ("tests/maps/test_spectral.py::test_a_place_without_a_descriptor_scores_cosine_0",),
    ),
    Mutant(
        "A query of length 0 scores 1 at every place of a cosine map, not NaN.",
        "dejavu_torch/maps/spectral_map.py",
        "queries / torch.where(length > 0, length, 1)",
        "queries / length",
        ("tests/maps/test_spectral.py::-k scores_are or without_a_descriptor",),
    ),
    Mutant(
        "The route's bytes stay within route_bytes_per_place with many chunks too: the header of every "
        "chunk counts.",
        "dejavu_torch/maps/spectral.py",
        "fixed = round(share * lines.mean_bytes) + CHUNK_BYTES * len(lines.chunks)",
        "fixed = round(share * lines.mean_bytes) + CHUNK_BYTES",
        ("tests/maps/test_spectral.py::-k budget and not summary",),
    ),
    Mutant(
        "With a resolution, cosine and sine of one frequency of the DFT have the same dead zone, by "
        "their period.",
        "dejavu_torch/maps/spectrum.py",
        "half_cycles(torch.arange(n), transform).double() / (2 * n)",
        "(torch.arange(n) // 2 * 2).double() / (2 * n)",
        ("tests/test_behaviour.py::test_cosine_and_sine_have_the_same_dead_zone",),
    ),
    Mutant(
        "A score of metric l2, the square of a distance, is never below 0, whatever rounding does.",
        "dejavu_torch/maps/spectral_map.py",
        "return (norms.to(products).square() - 2 * products + length.square()).clamp(min=0)",
        "return norms.to(products).square() - 2 * products + length.square()",
        ("tests/test_behaviour.py::test_a_squared_distance_is_never_below_0",),
    ),
    Mutant(
        "Levels that int8 does not hold, 128 and -128 on, come back from a map's lines as they were.",
        "dejavu_torch/maps/codec.py",
        "levels.min() >= -128 and levels.max() <= 127",
        "levels.min() >= -128",
        ("tests/maps/test_codec.py::test_a_stream_gives_the_levels_back",),
    ),
    Mutant(
        "A stream of coded lines with bytes left over at its end is refused.",
        "dejavu_torch/maps/codec.py",
        "if left or checksum",
        "if left < 0 or checksum",
        ("tests/maps/test_codec.py::-k too_many or anything",),
    ),
    Mutant(
        "A map file of an older format is refused.",
        "dejavu_torch/maps/file.py",
        'if (version := sealed["version"]) != FORMAT:',
        'if (version := sealed["version"]) > FORMAT:',
        ("tests/maps/test_file.py::test_what_is_no_map_is_refused",),
    ),
    Mutant(
        "Weights in 8 bits have a scale for each output channel: each is off by half of its own "
        "channel's step at most.",
        "dejavu_torch/maps/weights.py",
        "scale = (weight.abs().flatten(1).amax(1) / LARGEST).bfloat16()",
        "scale = (weight.abs().amax().expand(weight.shape[0]) / LARGEST).bfloat16()",
        ("tests/maps/test_weights.py::test_the_closed_form",),
    ),
    Mutant(
        "The bytes of a summary add up to the size of the map's file, its header included.",
        "dejavu_torch/maps/file.py",
        "return 8 + -(-len(text.encode()) // 8) * 8 + end",
        "return end",
        ("tests/maps/test_file.py::test_one_file_of_the_size_the_map_claims",),
    ),
    Mutant(
        "A match is accepted if its score is below the threshold, not at it.",
        "dejavu_torch/recognition/select.py",
        "found & (score < threshold)",
        "found & (score <= threshold)",
        ("tests/recognition/test_select.py::test_convention_4_accept_when_the_score_is_below_the_threshold",),
    ),
    Mutant(
        "With a precision an answer is accepted from that probability on, inclusive.",
        "dejavu_torch/recognition/localizer.py",
        "match.probability >= precision",
        "match.probability > precision",
        ("tests/test_behaviour.py::test_a_precision_is_inclusive",),
    ),
    Mutant(
        "Two candidates of a query are more than `radius` places from each other, to both sides of the "
        "better one.",
        "dejavu_torch/places/layout.py",
        "            near = places[:, None] + offset\n",
        "            near = places[:, None] + offset[:-1]\n",
        ("tests/recognition/test_select.py::test_candidates_equal_reference",),
    ),
    Mutant(
        "A search keeps enough of the best places that candidates and probabilities are those of all scores.",
        "dejavu_torch/recognition/search.py",
        "(k - 1) * layout.near(radius) + 1 for",
        "(k - 1) * (radius + 1) + 1 for",
        ("tests/recognition/test_search.py::-k candidates_are_those or calibrated_map",),
    ),
    Mutant(
        "In a PlaceFilter what drives off the end of the map is off the map afterwards: the prediction "
        "adds up to 1.",
        "dejavu_torch/recognition/motion.py",
        "self._began(self.lost).flatten(-3) + leave",
        "0 * self.lost.flatten(-3) + leave",
        ("tests/recognition/test_filter.py::-k literal_loop or drives_off",),
    ),
    Mutant(
        "A trajectory of which just half lies on the map still gives its place a finite score.",
        "dejavu_torch/recognition/sequence.py",
        "torch.where(2 * count >= used[:, None],",
        "torch.where(2 * count > used[:, None],",
        ("tests/recognition/test_sequence.py::test_equals_a_literal_loop",),
    ),
    Mutant(
        "Along a trajectory half a place is rounded up, as at a speed of 0.5.",
        "dejavu_torch/recognition/sequence.py",
        "math.floor(speed * k + 0.5)",
        "round(speed * k)",
        ("tests/recognition/test_sequence.py::test_equals_a_literal_loop",),
    ),
    Mutant(
        "A calibrated probability never falls as the evidence grows: where right answers had less of "
        "it, all get the share of right ones.",
        "dejavu_torch/recognition/calibration.py",
        "if slope < 0:",
        "if math.isnan(slope):",
        (
            "tests/recognition/test_calibration.py::test_evidence_that_tells_nothing_or_the_opposite_gives_the_share",
        ),
    ),
    Mutant(
        "Among equal scores in several chunks the lowest place wins, in a search of single queries too.",
        "dejavu_torch/recognition/search.py",
        "place, order = place.sort(1)",
        "place, order = place.sort(1, descending=True)",
        (
            "tests/test_behaviour.py::test_of_equal_scores_in_several_chunks_the_lowest_place_wins",
            "tests/recognition/test_search.py::test_the_best_of_blocks_are_those_of_all_scores",
        ),
    ),
    Mutant(
        "HOG of a colour frame takes, at each pixel, the gradient of the channel where it is longest.",
        "dejavu_torch/features/hog.py",
        "longer = length > longest",
        "longer = length < longest",
        ("tests/features/test_hog.py::test_each_pixel_takes_its_strongest_channel",),
    ),
    Mutant(
        "Linear orientation bins of HOG are cyclic over 180 degrees: the last one shares its votes with "
        "the first.",
        "dejavu_torch/features/hog.py",
        "((lower + 1).remainder_(orientations), magnitude",
        "((lower + 1).clamp_(max=orientations - 1), magnitude",
        ("tests/features/test_hog.py::test_linear_bins_equal_a_literal_loop",),
    ),
    Mutant(
        "Patch normalisation at the border of a frame counts only pixels inside it.",
        "dejavu_torch/features/preprocess.py",
        "(sums(frames) / sums(frames.new_ones(frames.shape[-1]))).mT",
        "(sums(frames) / side).mT",
        ("tests/features/test_preprocess.py::test_patches_equal_a_literal_loop",),
    ),
    Mutant(
        "Without views the constant number of a whitened descriptor is the root mean square of the kept "
        "ones.",
        "dejavu_torch/features/whitening.py",
        "each, whole = variances.mean().sqrt(), variances.sum().sqrt()",
        "each = whole = variances.sum().sqrt()",
        ("tests/features/test_whitening.py::test_without_views_components_keep_their_variances",),
    ),
    Mutant(
        "The shrinkage of a whitening that was not given one is at least 0.03, and more where views are few.",
        "dejavu_torch/features/whitening.py",
        "shrinkage = max(SHRINKAGE, oracle_shrinkage(within, min(n, samples or n)))",
        "shrinkage = min(SHRINKAGE, oracle_shrinkage(within, n))",
        ("tests/features/test_whitening.py::-k shrink",),
    ),
    Mutant(
        "In local contrast all channels of a frame are divided by the same contrast, so that colours "
        "stay comparable.",
        "dejavu_torch/features/cnn.py",
        "around(centred.square().mean(1, keepdim=True))",
        "around(centred.square())",
        ("tests/features/test_cnn.py::-k local_contrast or light or gain",),
    ),
    Mutant(
        "Augmented copies, and the places that they are said to show, are the same whatever the batch size.",
        "dejavu_torch/features/views.py",
        "size = self.traverse.at_once(size)\n",
        "size = self.block = self.traverse.at_once(size)\n",
        (
            "tests/test_spectral_model.py::test_copies_are_those_of_the_seed_and_in_order",
            "tests/recognition/test_calibration.py::test_changed_frames_show_their_places_whatever_the_batch",
        ),
    ),
    Mutant(
        "Appending places drops the calibration of the map, which was made for fewer places.",
        "dejavu_torch/model.py",
        "self.map, self.searcher, self.calibration = place_map, None, None",
        "self.map = route",
        ("tests/test_growth.py::test_a_calibration_goes_and_comes_again_from_the_new_places",),
    ),
    Mutant(
        "A third visit that is averaged into a map weighs a third.",
        "dejavu_torch/growth.py",
        "means = learning.with_visits(place_map.decode(g), counts[start:stop], rows",
        "means = learning.with_visits(place_map.decode(g), torch.ones(stop - start), rows",
        ("tests/test_behaviour.py::test_a_third_visit_weighs_a_third",),
    ),
    Mutant(
        "A merged map keeps a threshold only where all maps have that one.",
        "dejavu_torch/growth.py",
        '| {"threshold": first.threshold if len(thresholds) == 1 else None}',
        '| {"threshold": first.threshold}',
        ("tests/test_behaviour.py::test_a_threshold_is_kept_where_all_maps_have_it",),
    ),
    Mutant(
        "FILE.part of a run with other settings, or of another route, is refused, and not gone on with.",
        "dejavu_torch/learning.py",
        "if stored != key:",
        "if stored.keys() != key.keys():",
        ("tests/test_learning.py::-k partial_map_of_another_run or appended_to_a_map_are_kept",),
    ),
    Mutant(
        "On a cluster the places of a merged map, of three routes too, are those of a scan by one process.",
        "dejavu_torch/cluster.py",
        "place + self.first, place)",
        "place, place)",
        ("tests/test_cluster.py::test_parts_of_a_map_on_workers_find_what_the_whole_does",),
    ),
    Mutant(
        "Chunks of a long route, and of appended places, are coded with the resolution of the map.",
        "dejavu_torch/learning.py",
        "self.step, self.transform, self.resolution, columns)",
        "self.step, self.transform, 0.0, columns)",
        (
            "tests/test_growth.py::-k those_of_a_long_route or learned_at_once",
            "tests/maps/test_spectral.py::test_resolution_is_kept_and_extends_alike",
        ),
    ),
    Mutant(
        "A match on a map of shuffled frames (the null) tells the frame that is stored at the place.",
        "dejavu_torch/recognition/scorer.py",
        "self.place = order.argsort()",
        "self.place = order",
        (
            "tests/evaluation/test_controls.py::test_convention_8_a_match_of_the_null_names_the_frame_that_is_stored",
        ),
    ),
    Mutant(
        "Only steps shorter than `still` count as standing: steps backwards that are longer stay.",
        "dejavu_torch/motion/odometry.py",
        "shift = torch.where(shift.abs() < self.still, 0.0, shift)",
        "shift = torch.where(shift < self.still, 0.0, shift)",
        ("tests/motion/test_odometry.py::-k stops_and_a_reversal",),
    ),
    Mutant(
        "Footage of a camera that looks back is resampled like that of one that looks ahead.",
        "dejavu_torch/motion/resampling.py",
        "if -distance.min() > distance.max():",
        "if distance.min() > distance.max():",
        ("tests/motion/test_odometry.py::test_a_camera_that_looks_back",),
    ),
    Mutant(
        "Without a given step, places lie the median step of the frames that move apart; standing does "
        "not count.",
        "dejavu_torch/motion/resampling.py",
        "float(moved.abs()[moved != 0].median())",
        "float(moved.abs().median())",
        ("tests/motion/test_odometry.py::test_the_median_step_of_moving_frames_is_the_default",),
    ),
    Mutant(
        "The longest period is half the window: bins 0 and 1 of a spectrum, mean and drift, are never "
        "chosen.",
        "dejavu_torch/periods/spectrogram.py",
        "candidates[2 : last + 1] = power[2 : last + 1] > 0",
        "candidates[1 : last + 1] = power[1 : last + 1] > 0",
        ("tests/periods/test_spectrogram.py::-k between_the_shortest or strongest_bins",),
    ),
    Mutant(
        "Places behind the last whole window are a chunk of their own from just two shortest periods on.",
        "dejavu_torch/periods/spectrogram.py",
        "if chunks[-1][1] < places and places - rest >= shortest:",
        "if chunks[-1][1] < places and places - rest > shortest:",
        ("tests/periods/test_spectrogram.py::-k chunks",),
    ),
    Mutant(
        "Imposed periods tell all bins of a route apart, the short last one included.",
        "dejavu_torch/periods/imposed.py",
        "bins = -(-places // self.bin)",
        "bins = places // self.bin",
        ("tests/periods/test_imposed.py::test_places_that_look_alike_are_logged_in_one_line",),
    ),
    Mutant(
        "Behind k frames that were left out the live filter moves k + 1 times.",
        "dejavu_torch/live/localizer.py",
        "self._localizer.skip(min(left_out, MAX_SKIPPED))",
        "self._localizer.skip(min(max(left_out - 1, 0), MAX_SKIPPED))",
        ("tests/test_behaviour.py::test_frames_left_out_move_a_filter_on",),
    ),
    Mutant(
        "A live answer on a merged map gives the frame as counted on its own route.",
        "dejavu_torch/live/localizer.py",
        "frame=int(table.own_frame_of(match.index)),",
        "frame=shown,",
        ("tests/test_cli_growth.py::test_live_names_the_route",),
    ),
    Mutant(
        "Queries of equal score report together: a precision-recall curve has one point for each "
        "distinct score.",
        "dejavu_torch/evaluation/curves.py",
        "last[:-1] = ordered[1:] != ordered[:-1]",
        "last[:-1] = ordered[1:] >= ordered[:-1]",
        ("tests/evaluation/test_curves.py::test_queries_with_equal_scores_report_together",),
    ),
    Mutant(
        "A score that is read from matches.csv is the float32 number that was written.",
        "dejavu_torch/evaluation/matches.py",
        "digits = 17 if match.score.dtype == torch.float64 else 9",
        "digits = 17 if match.score.dtype == torch.float64 else 7",
        ("tests/evaluation/test_matches.py::-k written_in_parts or by_hand",),
    ),
]
