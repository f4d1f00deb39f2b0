"""Frustum PointNet v1 (Qi et al. 2018): a 3D box for every 2D box or mask, from its points (thesis Table 3.4)."""
