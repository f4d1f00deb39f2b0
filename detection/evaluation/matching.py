"""Who is found: the two matching passes of the KITTI devkit, kept per frame so that any set of frames can be summed.

Every label and detection carries a flag: 0 counts, 1 ignored (may match, counts neither way), -1 invisible.

Pass A, without a score threshold, gives each label the overlapping detection of the highest score; the scores of the
true positives become the thresholds of the curve. Pass B, at a threshold, gives each label the overlapping detection
of the largest IoU. Pass B changes only where a detection of the frame enters, so it is run at every such score once
and stored as *events* (what enters at this score changes tp, fp and similarity by so much). A curve over any frames,
each counted any number of times, is then a sum over events: this makes both AP and the bootstrap cheap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detection.evaluation.objects import Array
from detection.evaluation.overlaps import Index, Overlaps
from detection.ops._numba import kernel

Flags = NDArray[np.int8]

VALID, IGNORED, INVISIBLE = 0, 1, -1

# The devkit's stand-in for "nothing found": a score at or below it can never match in pass A.
_NO_DETECTION = -10000000.0


class MatchRecords(NamedTuple):
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


class MatchCandidates(NamedTuple):
    """What the matching looks at: who overlaps whom, who counts, and the scores (a tuple, as kernels take those).

    start, detection, iou, dontcare  as in `Overlaps`
    min_overlap                      a match needs an IoU strictly above it
    label_flag, detection_flag       (G,), (D,) int8 flags
    score                            (D,)
    """

    start: Index
    detection: Index
    iou: Array
    dontcare: Array
    min_overlap: float
    label_flag: Flags
    detection_flag: Flags
    score: Array


def match_candidates(
    overlaps: Overlaps, min_overlap: float, flags: tuple[Flags, Flags], scores: Array
) -> MatchCandidates:
    """Overlaps, limit, flags of labels (G,) and detections (D,), and scores (D,) in one."""
    pairs = (overlaps.start, overlaps.detection, overlaps.iou, overlaps.dontcare)
    return MatchCandidates(*pairs, float(min_overlap), *flags, scores)


def record_matches(
    label_offsets: Index, detection_offsets: Index, candidates: MatchCandidates, alphas: tuple[Array, Array]
) -> MatchRecords:
    """Run both passes on every frame.

    label_offsets, detection_offsets  (F + 1,) rows of each frame
    alphas                            (G,) of labels and (D,) of detections, radians
    """
    n_frames = len(label_offsets) - 1
    frames = np.repeat(np.arange(n_frames), np.diff(label_offsets))
    n_labels = np.bincount(frames[candidates.label_flag == VALID], minlength=n_frames).astype(np.int64)
    rows, tp_frame = _pass_a(label_offsets, candidates)
    tp_score = candidates.score[rows]
    score, frame, tp, fp, similarity = _pass_b_events(label_offsets, detection_offsets, candidates, *alphas)
    by_score, by_event = np.argsort(-tp_score, kind="stable"), np.argsort(-score, kind="stable")
    return MatchRecords(
        n_labels,
        tp_score[by_score],
        tp_frame[by_score],
        score[by_event],
        frame[by_event],
        tp[by_event],
        fp[by_event],
        similarity[by_event],
    )


def match_all(candidates: MatchCandidates) -> Index:
    """(G,) the detection row each label gets in pass B when every detection is admitted, -1 for none."""
    match = np.full(len(candidates.label_flag), -1, dtype=np.int64)
    taken = np.zeros(len(candidates.score), dtype=np.bool_)
    # A pair lies within one frame, so the labels of all frames can be walked at once.
    _match_at(float(-np.finfo(np.float64).max), 0, len(match), candidates, taken, match)
    return match


@kernel
def _pass_a(label_offsets: Index, r: MatchCandidates) -> tuple[Index, Index]:
    """Detection row and frame of every true positive when each label takes the highest score."""
    taken = np.zeros(len(r.score), dtype=np.bool_)
    rows = np.empty(len(r.label_flag), dtype=np.int64)
    frames = np.empty(len(r.label_flag), dtype=np.int64)
    count = 0
    for f in range(len(label_offsets) - 1):
        for g in range(label_offsets[f], label_offsets[f + 1]):
            if r.label_flag[g] == INVISIBLE:
                continue
            best, best_score = -1, _NO_DETECTION
            for p in range(r.start[g], r.start[g + 1]):
                d = r.detection[p]
                if r.detection_flag[d] == INVISIBLE or taken[d] or r.iou[p] <= r.min_overlap:
                    continue
                if r.score[d] > best_score:
                    best, best_score = d, r.score[d]
            if best >= 0:
                taken[best] = True
                if r.label_flag[g] == VALID and r.detection_flag[best] == VALID:
                    rows[count], frames[count] = best, f
                    count += 1
    return rows[:count].copy(), frames[:count].copy()


@kernel
def _match_at(
    threshold: float, first: int, last: int, r: MatchCandidates, taken: NDArray[np.bool_], match: Index
) -> None:
    """Pass B for labels first to last - 1 with detections of at least `threshold`; fills `taken` and `match`."""
    for g in range(first, last):
        match[g] = -1
        if r.label_flag[g] == INVISIBLE:
            continue
        best, best_iou, best_is_ignored = -1, 0.0, False
        for p in range(r.start[g], r.start[g + 1]):
            d = r.detection[p]
            flag, iou = r.detection_flag[d], r.iou[p]
            if flag == INVISIBLE or taken[d] or r.score[d] < threshold or iou <= r.min_overlap:
                continue
            if flag == VALID and (iou > best_iou or best_is_ignored):
                best, best_iou, best_is_ignored = d, iou, False
            elif flag == IGNORED and best < 0:
                best, best_is_ignored = d, True
        if best >= 0:
            match[g] = best
            taken[best] = True


@kernel
def _mark_contested(first: int, last: int, r: MatchCandidates, contested: NDArray[np.bool_]) -> None:
    """Mark the detections that some label of first to last - 1 could take."""
    for g in range(first, last):
        if r.label_flag[g] == INVISIBLE:
            continue
        for p in range(r.start[g], r.start[g + 1]):
            d = r.detection[p]
            if r.detection_flag[d] != INVISIBLE and r.iou[p] > r.min_overlap:
                contested[d] = True


@kernel
def _true_positives(
    first: int, last: int, r: MatchCandidates, match: Index, label_alpha: Array, detection_alpha: Array
) -> tuple[int, float]:
    """Their number and orientation similarity after pass B."""
    tp, similarity = 0, 0.0
    for g in range(first, last):
        d = match[g]
        if d >= 0 and r.label_flag[g] == VALID and r.detection_flag[d] == VALID:
            tp += 1
            similarity += (1.0 + np.cos(label_alpha[g] - detection_alpha[d])) / 2.0
    return tp, similarity


@kernel
def _is_stray(d: int, r: MatchCandidates) -> bool:
    """Whether an unmatched detection is a false positive: it counts and no DontCare area absorbs it."""
    return r.detection_flag[d] == VALID and r.dontcare[d] <= r.min_overlap


@kernel
def _pass_b_events(
    label_offsets: Index, detection_offsets: Index, r: MatchCandidates, label_alpha: Array, detection_alpha: Array
) -> tuple[Array, Index, Index, Index, Array]:
    """Score, frame and changes of tp, fp and similarity wherever the outcome of pass B changes."""
    n = len(r.score)
    score, frame, similarity = np.empty(n), np.empty(n, dtype=np.int64), np.empty(n)
    tp, fp = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    contested, taken = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    match = np.full(len(r.label_flag), -1, dtype=np.int64)
    count = 0
    for f in range(len(label_offsets) - 1):
        first, last = label_offsets[f], label_offsets[f + 1]
        begin, end = detection_offsets[f], detection_offsets[f + 1]
        _mark_contested(first, last, r, contested)
        # Detections that no label can take are false positives from their score on.
        for d in range(begin, end):
            if not contested[d] and _is_stray(d, r):
                score[count], frame[count], similarity[count] = r.score[d], f, 0.0
                tp[count], fp[count] = 0, 1
                count += 1
        candidates = begin + np.nonzero(contested[begin:end])[0]
        levels = np.unique(r.score[candidates])
        tp_before, fp_before, similarity_before = 0, 0, 0.0
        for k in range(len(levels) - 1, -1, -1):
            taken[begin:end] = False
            _match_at(levels[k], first, last, r, taken, match)
            tp_now, similarity_now = _true_positives(first, last, r, match, label_alpha, detection_alpha)
            fp_now = 0
            for d in candidates:
                if r.score[d] >= levels[k] and not taken[d] and _is_stray(d, r):
                    fp_now += 1
            score[count], frame[count], similarity[count] = levels[k], f, similarity_now - similarity_before
            tp[count], fp[count] = tp_now - tp_before, fp_now - fp_before
            count += 1
            tp_before, fp_before, similarity_before = tp_now, fp_now, similarity_now
    return score[:count].copy(), frame[:count].copy(), tp[:count].copy(), fp[:count].copy(), similarity[:count].copy()
