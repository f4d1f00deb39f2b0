"""Who is found: the two matching passes of the KITTI devkit, kept per frame so that any set of frames can be summed.

Every label and detection carries a flag: 0 counts, 1 ignored (may match, counts neither way), -1 invisible.

Pass A, without a score threshold, gives each label the overlapping detection of the highest score; the scores of the
true positives become the thresholds of the curve. Pass B, at a threshold, gives each label the overlapping detection
of the largest IoU. Pass B changes only where a detection of the frame enters, so it is run at every such score once
and stored as *events* (what enters at this score changes tp, fp and similarity by so much). A curve over any frames,
each counted any number of times, is then a sum over events: this makes both AP and the bootstrap cheap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detection.evaluation.objects import Array
from detection.evaluation.overlaps import Index, Overlaps
from detection.ops._numba import kernel

Flags = NDArray[np.int8]

VALID, IGNORED, INVISIBLE = 0, 1, -1

# The devkit's stand-in for "nothing found": a score at or below it can never match in pass A.
_NO_DETECTION = -10000000.0


@dataclass(frozen=True)
class MatchRecords:
    """Everything an AP value depends on, per frame.

    n_labels                          (F,) labels that count
    tp_score, tp_frame                (T,) true positives of pass A, score descending
    score, frame, tp, fp, similarity  (E,) events of pass B, score descending: changes of the counts of that frame;
                                      similarity sums (1 + cos(alpha difference)) / 2 over true positives
    """

    n_labels: Index
    tp_score: Array
    tp_frame: Index
    score: Array
    frame: Index
    tp: Index
    fp: Index
    similarity: Array


def record_matches(
    label_offsets: Index,
    detection_offsets: Index,
    overlaps: Overlaps,
    label_flag: Flags,
    detection_flag: Flags,
    scores: Array,
    alphas: tuple[Array, Array],
    min_overlap: float,
) -> MatchRecords:
    """Run both passes on every frame.

    label_flag, detection_flag  (G,), (D,) int8 flags
    scores                      (D,)
    alphas                      (G,) of labels and (D,) of detections, radians
    min_overlap                 a match needs an IoU strictly above it
    """
    frames = np.repeat(np.arange(len(label_offsets) - 1), np.diff(label_offsets))
    n_labels = np.bincount(frames[label_flag == VALID], minlength=len(label_offsets) - 1).astype(np.int64)
    offsets_and_pairs = (label_offsets, detection_offsets, overlaps.start, overlaps.detection, overlaps.iou)
    rows, tp_frame = _pass_a(*offsets_and_pairs, min_overlap, label_flag, detection_flag, scores)
    score, frame, tp, fp, similarity = _pass_b_events(
        *offsets_and_pairs, min_overlap, label_flag, detection_flag, scores, overlaps.dontcare, *alphas
    )
    by_score, by_event = np.argsort(-scores[rows], kind="stable"), np.argsort(-score, kind="stable")
    return MatchRecords(
        n_labels,
        scores[rows][by_score],
        tp_frame[by_score],
        score[by_event],
        frame[by_event],
        tp[by_event],
        fp[by_event],
        similarity[by_event],
    )


def match_all(
    overlaps: Overlaps,
    label_flag: Flags,
    detection_flag: Flags,
    scores: Array,
    min_overlap: float,
) -> Index:
    """(G,) the detection row each label gets in pass B when every detection is admitted, -1 for none."""
    match = np.full(len(label_flag), -1, dtype=np.int64)
    taken = np.zeros(len(detection_flag), dtype=np.bool_)
    # A pair lies within one frame, so the labels of all frames can be walked at once.
    _match_at(
        float(-np.finfo(np.float64).max),
        0,
        len(label_flag),
        overlaps.start,
        overlaps.detection,
        overlaps.iou,
        min_overlap,
        label_flag,
        detection_flag,
        scores,
        taken,
        match,
    )
    return match


@kernel
def _pass_a(
    label_offsets: Index,
    detection_offsets: Index,
    start: Index,
    pair_detection: Index,
    pair_iou: Array,
    min_overlap: float,
    label_flag: Flags,
    detection_flag: Flags,
    scores: Array,
) -> tuple[Index, Index]:
    """Detection row and frame of every true positive when each label takes the highest score."""
    taken = np.zeros(len(scores), dtype=np.bool_)
    rows = np.empty(len(label_flag), dtype=np.int64)
    frames = np.empty(len(label_flag), dtype=np.int64)
    count = 0
    for f in range(len(label_offsets) - 1):
        for g in range(label_offsets[f], label_offsets[f + 1]):
            if label_flag[g] == INVISIBLE:
                continue
            best, best_score = -1, _NO_DETECTION
            for p in range(start[g], start[g + 1]):
                d = pair_detection[p]
                if detection_flag[d] == INVISIBLE or taken[d] or pair_iou[p] <= min_overlap:
                    continue
                if scores[d] > best_score:
                    best, best_score = d, scores[d]
            if best >= 0:
                taken[best] = True
                if label_flag[g] == VALID and detection_flag[best] == VALID:
                    rows[count], frames[count] = best, f
                    count += 1
    return rows[:count].copy(), frames[:count].copy()


@kernel
def _match_at(
    threshold: float,
    first: int,
    last: int,
    start: Index,
    pair_detection: Index,
    pair_iou: Array,
    min_overlap: float,
    label_flag: Flags,
    detection_flag: Flags,
    scores: Array,
    taken: NDArray[np.bool_],
    match: Index,
) -> None:
    """Pass B for labels first to last - 1 with detections of at least `threshold`; fills `taken` and `match`."""
    for g in range(first, last):
        match[g] = -1
        if label_flag[g] == INVISIBLE:
            continue
        best, best_iou, best_is_ignored = -1, 0.0, False
        for p in range(start[g], start[g + 1]):
            d = pair_detection[p]
            if detection_flag[d] == INVISIBLE or taken[d] or scores[d] < threshold or pair_iou[p] <= min_overlap:
                continue
            if detection_flag[d] == VALID and (pair_iou[p] > best_iou or best_is_ignored):
                best, best_iou, best_is_ignored = d, pair_iou[p], False
            elif detection_flag[d] == IGNORED and best < 0:
                best, best_is_ignored = d, True
        if best >= 0:
            match[g] = best
            taken[best] = True


@kernel
def _pass_b_events(
    label_offsets: Index,
    detection_offsets: Index,
    start: Index,
    pair_detection: Index,
    pair_iou: Array,
    min_overlap: float,
    label_flag: Flags,
    detection_flag: Flags,
    scores: Array,
    dontcare: Array,
    label_alpha: Array,
    detection_alpha: Array,
) -> tuple[Array, Index, Index, Index, Array]:
    """Score, frame and changes of tp, fp and similarity wherever the outcome of pass B changes."""
    n = len(scores)
    event_score, event_similarity = np.empty(n, dtype=np.float64), np.empty(n, dtype=np.float64)
    event_frame = np.empty(n, dtype=np.int64)
    event_tp, event_fp = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    contested = np.zeros(n, dtype=np.bool_)
    taken = np.zeros(n, dtype=np.bool_)
    match = np.full(len(label_flag), -1, dtype=np.int64)
    count = 0
    for f in range(len(label_offsets) - 1):
        first, last = label_offsets[f], label_offsets[f + 1]
        begin, end = detection_offsets[f], detection_offsets[f + 1]
        for g in range(first, last):
            if label_flag[g] == INVISIBLE:
                continue
            for p in range(start[g], start[g + 1]):
                d = pair_detection[p]
                if detection_flag[d] != INVISIBLE and pair_iou[p] > min_overlap:
                    contested[d] = True
        # Detections that no label can take are false positives from their score on, unless DontCare absorbs them.
        for d in range(begin, end):
            if detection_flag[d] == VALID and not contested[d] and dontcare[d] <= min_overlap:
                event_score[count], event_frame[count] = scores[d], f
                event_tp[count], event_fp[count], event_similarity[count] = 0, 1, 0.0
                count += 1
        rivals = begin + np.nonzero(contested[begin:end])[0]
        levels = np.unique(scores[rivals])
        tp_before, fp_before, similarity_before = 0, 0, 0.0
        for k in range(len(levels) - 1, -1, -1):
            taken[begin:end] = False
            _match_at(
                levels[k],
                first,
                last,
                start,
                pair_detection,
                pair_iou,
                min_overlap,
                label_flag,
                detection_flag,
                scores,
                taken,
                match,
            )
            tp, fp, similarity = 0, 0, 0.0
            for g in range(first, last):
                if match[g] >= 0 and label_flag[g] == VALID and detection_flag[match[g]] == VALID:
                    tp += 1
                    similarity += (1.0 + np.cos(label_alpha[g] - detection_alpha[match[g]])) / 2.0
            for d in rivals:
                active = detection_flag[d] == VALID and scores[d] >= levels[k]
                if active and not taken[d] and dontcare[d] <= min_overlap:
                    fp += 1
            event_score[count], event_frame[count] = levels[k], f
            event_tp[count], event_fp[count] = tp - tp_before, fp - fp_before
            event_similarity[count] = similarity - similarity_before
            count += 1
            tp_before, fp_before, similarity_before = tp, fp, similarity
    return (
        event_score[:count].copy(),
        event_frame[:count].copy(),
        event_tp[:count].copy(),
        event_fp[:count].copy(),
        event_similarity[:count].copy(),
    )
