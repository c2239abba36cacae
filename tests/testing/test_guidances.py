"""The laws of guidance: kept by our own kinds, each broken by one altered kind."""

import dataclasses

import jax.numpy as jnp
import pytest
from probes import Aimed, Chain, Window, long_but

from cuelearner_jax.guides import registry
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.testing import check_guidance
from cuelearner_jax.testing.guidances import SMALL

FEW = ("a flat target", "a branch", "an unfitted guide")
SIZES = dataclasses.replace(SMALL, feedback_layers=(4,), fit_steps=2, validate_every=2)


def altered(form=lambda form: form, **changes):
    """The paper's kind with other methods, each made from the one that is there: (method) -> method."""
    kind = registry.find("relative")
    methods = {name: change(getattr(kind.guide, name)) for name, change in changes.items()}
    return dataclasses.replace(kind, guide=type("Altered", (kind.guide,), methods), form=form(kind.form))


def result(change):
    """A method whose result is changed."""
    return lambda method: lambda *given: change(method(*given))


def answering(change):
    """A form of answers that says something else."""
    return lambda form: form._replace(answer=lambda *given: change(*form.answer(*given)))


def in_python(act):
    return lambda *given: act(*given) if float(given[-1].eps_deg) > 1 else None


def everywhere(act):
    return lambda self, model, env, obs, actions, active, scalars: Refinement(-actions, active.astype(jnp.int32))


def unfitted_too(act):
    def guided(self, model, env, obs, actions, active, scalars):
        return Refinement(jnp.where(active[:, None], -actions, actions), active.astype(jnp.int32))

    return guided


def marked(fitted):
    return result(lambda model: model.replace(fitted=jnp.array(fitted)))


BROKEN = {
    "a long answer": (altered(form=answering(lambda h, told: (jnp.tile(h, 2), told))), "an answer has shape (2,)"),
    "a nameless form": (altered(form=lambda form: form._replace(name="A form")), "lacks a name in lower case"),
    "a number for told": (altered(form=answering(lambda h, told: (h, 1.0 * told))), "`answered` is no bool"),
    "a flat target": (altered(target=result(lambda target: target.sum())), "`target` of one label has shape ()"),
    "no fit": (altered(fit=marked(False)), "`fit` of valid labels returns an unfitted model"),
    "a fit of nothing": (altered(fit=marked(True)), "`fit` without a valid label returns a fitted model"),
    "another model": (altered(fit=result(lambda model: model.replace(params={}))), "a model of other fields or shapes"),
    "a branch": (altered(act=in_python), "`act` under jit fails"),
    "all rows": (altered(act=everywhere), "`act` changes rows that are not active"),
    "an unfitted guide": (altered(act=unfitted_too), "`act` of an unfitted model changes actions"),
    "no directions": (
        altered(act=result(lambda refined: refined._replace(actions=2.0 * refined.actions))),
        "an action that `act` returns is not an action of the space",
    ),
    "no count": (
        altered(act=result(lambda refined: refined._replace(passes=1.0 * refined.passes))),
        "`act` returns passes that are no count",
    ),
    "a question of no action": (altered(question=result(lambda asked: asked[:1])), "`question` returns shape (1,)"),
}


@pytest.mark.parametrize("law", long_but(FEW, BROKEN))
def test_a_broken_law_is_told_in_one_line(law):
    kind, told = BROKEN[law]
    with pytest.raises(AssertionError) as raised:
        check_guidance(kind, Window(), SIZES)
    assert told in str(raised.value)
    assert str(raised.value).startswith("guidance relative: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "name", long_but(("none", "relative"), [kind.name for kind in registry.kinds() if not kind.by_evidence])
)
def test_our_own_kinds_keep_the_laws(name):
    check_guidance(registry.find(name), Aimed(mirrors=True), SIZES)


def test_what_a_kind_needs_must_be_there():
    class Plain(Window):
        """An environment of which nothing is obvious."""

        heuristic = None

    with pytest.raises(AssertionError, match="it needs a heuristic, which Plain lacks"):
        check_guidance(registry.find("heuristic"), Plain(), SIZES)
    check_guidance(registry.find("heuristic"), Chain(), SIZES)
