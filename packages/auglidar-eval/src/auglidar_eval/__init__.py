"""KITTI average precision of two folders of label and result files, or of objects in memory; NumPy and Numba only.

    from auglidar_eval import evaluate

    report = evaluate("label_2", "detections", classes=["Car"])

The modules below are those of AugLiDAR, under the same names.
"""

from auglidar_eval.detection.evaluation.kitti_ap import Evaluation, Report, evaluate, prepare
from auglidar_eval.detection.evaluation.protocol import EvaluationProtocol
from auglidar_eval.detection.kitti_format import KittiObject, parse_lines

__all__ = ["Evaluation", "EvaluationProtocol", "KittiObject", "Report", "evaluate", "parse_lines", "prepare"]
