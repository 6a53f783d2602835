"""Controllers in the hands of a person, through a runtime of OpenXR (the specification 1.0, by pyopenxr).

The session is headless (XR_MND_headless): the person looks at the page, and the headset, if there is one, may lie on the desk.
"""

import ctypes
import importlib.util
import logging
import os
import time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros.learning.by_person import Word
from endo_sim_ros.learning.devices.hands import Grip, Hand
from endo_sim_ros.learning.person_config import OpenXRConfig

_EXTENSIONS = {"XR_MND_headless": "to hear controllers without drawing", "XR_KHR_convert_timespec_time": "to know the time"}
_HANDS = ("/user/hand/right", "/user/hand/left")  # in the order of the arms: PSM1 is on the right
# Of each interaction profile: what is held to act, what closes the jaw, and two buttons of the right and two of the left hand.
_INPUTS = {
    "khr/simple_controller": ("select/click", "menu/click", (), ()),
    "oculus/touch_controller": ("squeeze/value", "trigger/value", ("a/click", "b/click"), ("x/click", "y/click")),
    "valve/index_controller": ("squeeze/value", "trigger/value", ("a/click", "b/click"), ("a/click", "b/click")),
    "htc/vive_controller": ("squeeze/click", "trigger/value", ("menu/click", "trackpad/click"), ("menu/click", "trackpad/click")),
    "microsoft/motion_controller": ("squeeze/click", "trigger/value", ("menu/click", "trackpad/click"), ("menu/click", "trackpad/click")),
}
_WORDS: tuple[tuple[Word, Word], ...] = (("again", "next"), ("drop", "finish"))  # by the buttons of the right and the left hand

_logger = logging.getLogger(__name__)


class Runtime:
    """A session of a runtime, and what it tells of the hands.

    Raises:
        ValueError: If pyopenxr is not installed, or there is no runtime that can be used.
    """

    def __init__(self):
        os.environ.setdefault("XR_LOADER_DEBUG", "none")  # what it would print is said in the sentence
        try:
            import xr  # pyright: ignore[reportMissingImports]  (optional)
        except (ImportError, OSError, AttributeError) as error:  # the last two where it finds no OpenGL
            raise ValueError(f"openxr: pyopenxr cannot be used ({error}); pip install 'endo_sim_ros[openxr]'") from error
        self._xr, self._instance, self._running = xr, None, False
        try:
            self._begin()
        except xr.exception.XrException as error:
            self.close()
            raise ValueError(f"openxr: no runtime can be used ({type(error).__name__}); start one, such as monado-service") from error

    def _begin(self) -> None:
        xr = self._xr
        known = {each.extension_name.decode() for each in xr.enumerate_instance_extension_properties()}
        for extension, purpose in _EXTENSIONS.items():
            if extension not in known:
                raise ValueError(f"openxr: the runtime has no {extension}, {purpose}; take another one, such as Monado")
        application = xr.ApplicationInfo("endo_sim_ros", 1, "endo_sim_ros", 1, xr.Version(1, 0, 0))
        self._instance = xr.create_instance(xr.InstanceCreateInfo(application_info=application, enabled_extension_names=[*_EXTENSIONS]))
        self._runtime = xr.get_instance_properties(self._instance).runtime_name.decode()
        system = xr.get_system(self._instance, xr.SystemGetInfo(xr.FormFactor.HEAD_MOUNTED_DISPLAY))
        self._session = xr.create_session(self._instance, xr.SessionCreateInfo(system_id=system))
        self._set = xr.create_action_set(self._instance, xr.ActionSetCreateInfo("hands", "Hands"))
        self._hands = [self._path(hand) for hand in _HANDS]
        kind = xr.ActionType.BOOLEAN_INPUT  # of a trigger, too: runtimes know from where on it counts as pressed
        words = [word for words in _WORDS for word in words]
        self._switches = {name: self._action(name, kind) for name in ("held", "closed", *words)}
        grip = self._action("grip", xr.ActionType.POSE_INPUT)
        for profile, (held, closed, *buttons) in _INPUTS.items():
            bound = []
            for hand, names, words in zip(_HANDS, buttons, _WORDS):
                inputs = {"held": held, "closed": closed, **dict(zip(words, names))}
                bound += [(self._switches[name], f"{hand}/input/{where}") for name, where in inputs.items()]
                bound.append((grip, f"{hand}/input/grip/pose"))
            bindings = [xr.ActionSuggestedBinding(action, self._path(where)) for action, where in bound]
            suggestion = xr.InteractionProfileSuggestedBinding(self._path(f"/interaction_profiles/{profile}"), suggested_bindings=bindings)
            xr.suggest_interaction_profile_bindings(self._instance, suggestion)
        xr.attach_session_action_sets(self._session, xr.SessionActionSetsAttachInfo(action_sets=[self._set]))
        spaces = [xr.ActionSpaceCreateInfo(action=grip, subaction_path=hand) for hand in self._hands]
        self._spaces = [xr.create_action_space(self._session, space) for space in spaces]
        self._room = xr.create_reference_space(self._session, xr.ReferenceSpaceCreateInfo(xr.ReferenceSpaceType.LOCAL))

    def _path(self, text: str) -> Any:
        return self._xr.string_to_path(self._instance, text)

    def _action(self, name: str, kind: Any) -> Any:
        xr = self._xr
        info = xr.ActionCreateInfo(action_name=name, action_type=kind, subaction_paths=self._hands, localized_action_name=name.capitalize())
        return xr.create_action(self._set, info)

    def name(self, hand: int) -> str:
        """Which hand it is, and of what runtime."""
        return f"{('right', 'left')[hand]} hand of {self._runtime}"

    def gone(self, hand: int) -> bool:
        """Whether it is heard no more, which is so for both or none."""
        return self._instance is None

    def grip(self, hand: int) -> Grip | None:
        """How a hand is now, 0 = the right one, 1 = the left one; None where its controller is not seen, or the runtime is gone."""
        if self.gone(hand):
            return None
        try:
            return self._grip(hand)
        except self._xr.exception.QualifiedSuccessResult:  # other programs have the controllers
            return None
        except self._xr.exception.XrException as error:
            self.close()
            _logger.warning("openxr: the runtime is gone (%s); the mouse and the keys go on", type(error).__name__)
            return None

    def _grip(self, hand: int) -> Grip | None:
        xr = self._xr
        self._hear()
        if not self._running:
            return None
        xr.sync_actions(self._session, xr.ActionsSyncInfo(active_action_sets=[xr.ActiveActionSet(self._set, xr.NULL_PATH)]))
        seconds, nanoseconds = divmod(time.monotonic_ns(), 10**9)  # the clock of Linux that the extension takes
        now = xr.convert_timespec_time_to_time_khr(self._instance, xr.timespec(seconds, nanoseconds))
        found = xr.locate_space(self._spaces[hand], self._room, now)
        seen = xr.SPACE_LOCATION_POSITION_TRACKED_BIT | xr.SPACE_LOCATION_ORIENTATION_TRACKED_BIT
        if found.location_flags & seen != seen:
            return None
        place, turned = found.pose.position, found.pose.orientation
        infos = {name: xr.ActionStateGetInfo(action, self._hands[hand]) for name, action in self._switches.items()}
        on = {name: bool(xr.get_action_state_boolean(self._session, info).current_state) for name, info in infos.items()}
        rotation = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w])
        words: list[Word] = [word for word in _WORDS[hand] if on[word]]
        return Grip(np.array([place.x, place.y, place.z]), rotation, on["held"], on["closed"], frozenset(words))

    def _hear(self) -> None:
        """What the runtime says of the session."""
        xr = self._xr
        while True:
            try:
                event = xr.poll_event(self._instance)
            except xr.exception.EventUnavailable:
                return
            if event.type == xr.StructureType.EVENT_DATA_INSTANCE_LOSS_PENDING.value:
                raise xr.exception.InstanceLostError
            if event.type != xr.StructureType.EVENT_DATA_SESSION_STATE_CHANGED.value:
                continue
            state = xr.SessionState(ctypes.cast(ctypes.byref(event), ctypes.POINTER(xr.EventDataSessionStateChanged)).contents.state)
            if state == xr.SessionState.READY:
                xr.begin_session(self._session, xr.SessionBeginInfo())
                self._running = True
            elif state == xr.SessionState.STOPPING:
                xr.end_session(self._session)
                self._running = False
            elif state in (xr.SessionState.EXITING, xr.SessionState.LOSS_PENDING):
                raise xr.exception.SessionLostError

    def close(self) -> None:
        """End the session."""
        instance, self._instance = self._instance, None
        if instance is not None:
            try:
                self._xr.destroy_instance(instance)
            except self._xr.exception.XrException:
                pass  # a runtime that is gone


def find_hands(config: OpenXRConfig) -> tuple[Hand, ...]:
    """Both hands; none where they are not wanted, or there is no runtime and none is asked for.

    Raises:
        ValueError: If they are asked for, and pyopenxr or its runtime cannot be used.
    """
    if config.use == "off" or config.use == "auto" and importlib.util.find_spec("xr") is None:
        return ()
    try:
        runtime = Runtime()
    except ValueError as error:
        if config.use == "on":
            raise
        _logger.info("%s", error)
        return ()
    heading = Rotation.from_euler("y", -config.heading, degrees=True)
    return tuple(Hand(runtime, number, config, heading, number) for number in range(len(_HANDS)))
