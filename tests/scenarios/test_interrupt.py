"""Ctrl-C between the steps of a run."""

import os
import signal

import pytest

from scenarios.run.interrupt import between_steps, was_interrupted


def test_the_first_ctrl_c_waits_for_the_check():
    with between_steps() as check:
        check()
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            check()


def test_the_second_ctrl_c_does_not_wait():
    with between_steps():
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_afterwards_ctrl_c_is_what_it_was():
    before = signal.getsignal(signal.SIGINT)
    with between_steps():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interruption_is_known_through_what_compiled_code_made_of_it():
    made = SystemError("returned a result with an exception set")
    made.__cause__ = SystemError("returned a result with an exception set")
    made.__cause__.__cause__ = KeyboardInterrupt()
    assert was_interrupted(made)
    assert not was_interrupted(SystemError("bad argument"))
