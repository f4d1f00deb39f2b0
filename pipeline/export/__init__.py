"""Runs in the layouts of other projects: OpenPCDet, mmdetection3d, SFD, VirConv/TED, plain files."""
