"""Made-up results of a sweep, for tests of what becomes of them."""

from slam.app.sweep.bound import BoundSummary
from slam.app.sweep.run import Case, SweepRun
from slam.library.evaluation import LandmarkScore


def run_of(case: Case) -> SweepRun:
    """Return numbers that depend on the case alone, every field set."""
    return SweepRun(
        scene=case.scene.name,
        preset=case.preset,
        seed=case.seed,
        settings=dict(case.settings),
        stress=case.stress,
        frames=100,
        duration_s=10.0,
        realtime_factor=50.0,
        ate_rmse_m=0.01 + 0.001 * case.seed + 0.1 / 3,
        smoothed_ate_rmse_m=0.003 + 0.1 / 9,
        smoothed_landmarks=LandmarkScore(
            true=4,
            observable=4,
            estimated=5,
            precision=0.8,
            recall=None,
            duplicates=1,
            rmse_m=0.004,
        ),
        smoothed_nees_pose=((1.0, 1.5), (9.9, 2.5)),
        ate_icp_rmse_m=0.005,
        odometry_ate_rmse_m=0.04,
        final_error_m=0.02,
        landmarks=LandmarkScore(
            true=4,
            observable=4,
            estimated=4,
            precision=None,
            recall=1.0,
            duplicates=case.seed % 2,
            rmse_m=0.01,
        ),
        nees_pose=((1.0, 2.0), (9.9, 1.0)),
        nis_mean=None,
        nis_times=((1.0, 2.5, 2), (9.9, 0.0, 0)),
        false=2,
        confident_false=1,
        family="",
        lost_share=0.0,
        lost_at_end=False,
        confidently_wrong_share=0.0,
        carry=None,
        bound=BoundSummary(
            filtered_ate_rmse_m=0.1 / 7, smoothed_ate_rmse_m=0.003, nees_pose=((1.0, 3.0),)
        ),
    )
