"""Every error probe_kit raises on purpose, with the exit code the command line gives it.

Each message says what was seen, what was expected, and what to do.

Exit codes: 1 the result is not what was asked, 2 wrong usage, 3 refused.
"""

import errno

FULL_DISK = {
    errno.ENOSPC: "is full",
    errno.EDQUOT: "has no quota left for you",
    errno.EFBIG: "or a limit of this process (ulimit -f) takes no file so large",
}
"""The reasons for which a disk takes no more bytes, in words, by error number."""


class ProbeKitError(Exception):
    """Base of all errors below; catch it to catch them all."""

    exit_code = 1


# -- wrong usage -------------------------------------------------------------------------------------


class UsageError(ProbeKitError):
    """An argument has a value that is not allowed."""

    exit_code = 2


class UnknownModelError(UsageError):
    """No family or policy of this name is registered."""


class UnknownCategoryError(UsageError):
    """The suite has no such category."""


class UnknownSiteError(UsageError):
    """The policy or the run has no such site or view."""


class UnsupportedInterventionError(UsageError):
    """The family does not support the intervention that was asked for."""


class NoDirectionError(UsageError):
    """The class means of an answer are equal at a place, so that no direction leads from one to the other."""


class RunNotFoundError(UsageError):
    """The folder is not a run."""


class NoProbesError(UsageError):
    """The run has activations but no probe results yet, or no activations at all."""


class NoInterventionsError(UsageError):
    """Nothing of this kind was changed in the run's policy yet, or only in other episodes than it has now."""


class NoTrajectoryError(UsageError):
    """The run keeps no trajectories, because it was made before they were stored."""


# -- files of the user -------------------------------------------------------------------------------


class LfsPointerError(ProbeKitError):
    """A file is a Git LFS pointer, the few lines that stand for a file whose content was never fetched."""

    exit_code = 3


# -- suite and environment ---------------------------------------------------------------------------


class SuiteError(ProbeKitError):
    """The suite is invalid: a picture is missing or changed, a field is wrong, the hash differs."""


class SuiteNotFoundError(UsageError):
    """The pictures of a run's suite are needed, no folder was given, and they cannot be drawn again."""


class SceneError(ProbeKitError):
    """The scene cannot be built as described, such as overlapping outcome zones."""

    exit_code = 2


class RecordingError(ProbeKitError):
    """A data set of recordings cannot be read, or does not fit the model."""

    exit_code = 3


class UnitsError(ProbeKitError):
    """States of a source lie far outside the statistics of the checkpoint that reads them."""

    exit_code = 3


class OwnEnvironmentError(ProbeKitError):
    """An environment of the user's own breaks its contract, raised an error, or does not fit the model."""

    exit_code = 3


class IgnoredInputsError(ProbeKitError):
    """Neither another picture nor another instruction changes what a model puts out."""

    exit_code = 3


class ActionError(ProbeKitError, ValueError):
    """An action has the wrong shape or is not finite; the environment did not move."""


class EpisodeOverError(ProbeKitError, RuntimeError):
    """`step` was called before `reset` or after the end of an episode."""


# -- policies and capture ----------------------------------------------------------------------------


class WeightsError(ProbeKitError):
    """The weights in the file are not exactly the weights of the model."""

    exit_code = 3


class PolicyFailedError(ProbeKitError):
    """The code of a policy raised an error of its own, ended the process, or returned no valid action."""


class CheckpointError(ProbeKitError):
    """A file that belongs to a checkpoint is missing or contradicts another."""

    exit_code = 3


class InstructionError(ProbeKitError):
    """The instruction does not fit the policy: too long, or words its tokenizer does not know."""


class ObservationError(ProbeKitError):
    """An observation lacks a camera or a state, or has the wrong type or range."""


class CaptureError(ProbeKitError):
    """A capture cannot be started: one is already active, or the module is compiled."""


class SiteNeverFiredError(CaptureError):
    """A site fired fewer times than the policy promises."""


class SiteFiredTooOftenError(CaptureError):
    """A site fired more times than the policy promises."""


class CaptureChangedActionError(CaptureError):
    """Actions with and without capture differ."""


class NonFiniteActivationError(CaptureError):
    """A captured activation holds NaN or infinity."""


class EmptyRoleError(CaptureError):
    """A pooled view was asked for, but a row has no token of that role."""


class RolesMismatchError(CaptureError):
    """An adapter's `roles()` names another number of positions than its stream has."""


# -- runs --------------------------------------------------------------------------------------------


class SettingsMismatchError(ProbeKitError):
    """The folder holds a run with other settings."""

    exit_code = 3


class DiskSpaceError(ProbeKitError):
    """The disk is full or read-only, or the run would not fit on it."""

    exit_code = 3


class StoreError(ProbeKitError):
    """An object store cannot be reached, refuses, or cannot keep several writers apart."""

    exit_code = 3


class RunDamagedError(ProbeKitError):
    """Stored bytes are missing or differ from what was committed."""


class ActivationsLeftOutError(ProbeKitError):
    """A run is a copy without activations, and they were asked for."""

    exit_code = 3


class OtherFramesError(ProbeKitError):
    """Two runs did not begin with the same frames, or one of them does not say what its frames were."""

    exit_code = 3


class RunIncompleteError(ProbeKitError):
    """Episodes of the plan are not committed yet."""


class EpisodesFailedError(ProbeKitError):
    """Episodes were given up after failing twice; all others are kept."""


class StageDiedError(ProbeKitError):
    """The process that simulates an episode ended in the middle of it."""


class WorkerDiedError(ProbeKitError):
    """A worker process ended before its first episode, or while it probed."""


class MissingExtraError(ProbeKitError):
    """A feature needs an optional dependency that is not installed."""

    exit_code = 2


# -- probes ------------------------------------------------------------------------------------------


class TooFewGroupsError(ProbeKitError):
    """There are fewer independent groups than folds, or only one class."""


class UnbalancedEpisodesError(ProbeKitError):
    """A run lacks so many episodes of one side that the other is right without any knowledge."""

    exit_code = 3


class ProbeNotConvergedError(ProbeKitError):
    """The logistic solver stopped before the optimum."""
