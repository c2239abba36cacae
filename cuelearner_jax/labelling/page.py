"""The labelling page in a browser: one question, its answers and the progress. All state is the session's."""

from __future__ import annotations

import asyncio
import html
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from nicegui import run, ui
from nicegui.events import GenericEventArguments

from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling import controls, view
from cuelearner_jax.labelling.controls import Control
from cuelearner_jax.labelling.questions import Item
from cuelearner_jax.labelling.session import Session, Status
from cuelearner_jax.spaces import UNSAID

HERE = Path(__file__).parent
LATE = "the next question was already shown"  # why an answer was ignored

Finish = Callable[[], Awaitable[None]]  # ends the session; raises UserError if the labels cannot be saved


class Page:
    """One browser's view of a session; several browsers may show the same session."""

    def __init__(self, session: Session, pages: set[Page], finish: Finish | None = None, again: str = "") -> None:
        """Build the page in NiceGUI's current client; the page is among the session's open `pages` while it is open.

        `finish` is called by the button that ends the session; None: no such button. `again` is the command that opens
        the session once more.
        """
        self.session, self._finish, self._pages = session, finish, pages
        self.form, self.space, self._one_cue = session.plan.form, session.questions.space, session.plan.one_cue
        films = session.films, session.questions.pictures.simulates
        self.controls = controls.controls(self.form, self.space, self._one_cue, *films)
        self._parts: dict[int, float] = {}  # parts of the answer chosen so far, by the cue's index
        self._parts_of = session.number
        self._item: Item | None = None  # the item on the screen
        self._client = ui.context.client
        ui.add_css((HERE / "page.css").read_text())
        keys = {key: name for name, control in self.controls.items() for key in control.keys}
        script = (HERE / "page.js").read_text() + f"cue.keys = {json.dumps(keys)}; cue.again = {json.dumps(again)};"
        script = script.replace("</", "<\\/")  # an unescaped "</" would end the script
        ui.add_head_html(f"<script>{script}</script>")
        rows = sum(cue.is_asked for cue in self.space.cues) if len(self.space.cues) > 1 and self.form.by_eps else 0
        with ui.element("main").classes("label-page many" if rows else "label-page").style(f"--rows: {rows}"):
            with ui.column().classes("asking w-full gap-2"):
                ui.label(session.plan.task.wants(session.plan.config.task)).classes("note")
                self._question = ui.label(controls.question(self.form, self.space)).classes("big")
                self._note = ui.label().classes("note")
                self._scene = ui.html("", sanitize=False).classes("stage")
            with ui.column().classes("answering w-full gap-2"):
                self._build_answers()
            with ui.element("aside").classes("side"):
                self._build_side()
        with ui.dialog() as self._help, ui.card().classes("gap-1"):
            ui.label("Help").classes("big")
            for line in controls.help_lines(self.form, self.space, self.controls.values()):
                ui.label(line)
            ui.button("close", on_click=self._help.close)
        ui.on("cue", self._heard)
        pages.add(self)
        loop = asyncio.get_running_loop()
        stop = session.listen(lambda: loop.call_soon_threadsafe(self.refresh))
        self._client.on_delete(lambda: (pages.discard(self), stop()))
        self.refresh()

    def _button(self, control: Control, props: str = "") -> ui.button:
        """Make a button whose event names the control and the item on the screen."""
        with ui.button(color=None).props(props).classes(control.colour).mark(control.name) as button:
            words, key = html.escape(control.words), html.escape(control.first_key)
            ui.html(f"{words}<span class=key>{key}</span>", sanitize=False)
        send = f"event => cue.send({json.dumps(control.name)}, {{clicks: event.detail}})"
        button.on("click", lambda event, name=control.name: self._heard(event, name), js_handler=send)
        return button

    def _build_answers(self) -> None:
        own = controls.answers(self.form, self.space, self._one_cue)
        self._pressable: list[ui.button] = []
        self._picks: dict[Control, ui.button] = {}
        for number, cue in enumerate(self.space.cues):
            if about := [control for control in own if control.cue == number]:
                # a row per cue, beside the picture, which has the height and most of the width
                with ui.element("div").classes("cue"):
                    ui.label(cue.name)
                    with ui.element("div").classes("answers"):
                        buttons = {control: self._button(control) for control in about}
                self._pressable += buttons.values()
                self._picks |= {control: button for control, button in buttons.items() if control.picks}
        with ui.element("div").classes("answers"):
            self._pressable += [self._button(control) for control in own if control.cue is None]
            self._pressable.append(self._button(self.controls["unsure"]).classes("wide"))
        ui.label("").classes("dropped").props("aria-live=polite")
        ui.label("").classes("film-words")

    def _build_side(self) -> None:
        self._count = ui.label().classes("big")
        self._bar = ui.linear_progress(value=0.0, show_value=False).props("rounded size=10px")
        self._pace, self._minutes = ui.label(), ui.label()
        ui.separator()
        self._model, self._quality = ui.label(), ui.label().classes("told")
        ui.separator()
        self._words = ui.label()
        with ui.element("div").classes("hide-small"):
            turns = [one for one in self.controls.values() if one.colour in ("left", "right") and one.cue is None]
            by_evidence = self.session.plan.guidance.by_evidence
            swatches = {} if self.form.second else {"asked": "the action in question"}
            swatches |= {one.colour: one.words for one in turns}
            swatches["refined"] = "the corrected policy" if by_evidence else "the model's correction"
            for name, about in swatches.items():
                ui.html(
                    f'<span class=swatch style="background:var(--{name})"></span>{html.escape(about)}', sanitize=False
                )
            ui.label(self.session.questions.pictures.legend).classes("text-caption")
        with ui.element("div").classes("tools"):
            names = [name for name in self.controls if name in ("undo", "help") or name.startswith("film")]
            self._tools = {name: self._button(self.controls[name], "flat dense") for name in names}
        self._path = ui.label().classes("text-caption")
        self._trouble = ui.label().classes("trouble")
        if self._finish is not None:
            ui.button("finish", on_click=self._end, color="grey-7").mark("finish")

    async def _heard(self, event: GenericEventArguments, name: str | None = None) -> None:
        """Handle a control's event; without an item from the browser, it is about the current question."""
        event_data = event.args if isinstance(event.args, dict) and "name" in event.args else {"name": name}
        item = event_data.get("item")
        await self._act(str(event_data["name"]), self.session.number if item is None else int(item), event_data)

    async def _act(self, name: str, number: int, data: dict[str, Any]) -> None:
        """Act on a control pressed, or a direction pointed at, while an item was on the screen."""
        control, angle = self.controls.get(name), data.get("angle")
        if name == "help":
            self._help.value = not self._help.value
        elif name.startswith("film"):
            await self._show_film(name.removeprefix("film-"), number)
        elif control is not None or (name == "point" and self.form.is_action and angle is not None):
            if why := await self._taken(control, number, angle, data.get("seconds")):
                self._script(f"cue.refused({json.dumps(why)})")
            for page in list(self._pages):
                page.refresh()

    async def _taken(self, control: Control | None, number: int, angle: float | None, seconds: float | None) -> str:
        """Take an answer, a part of one, or an answer back; return why not, empty if it was taken."""
        if self._help.value:  # the browser may not know yet that the window opened
            return "a window lies over the question: close it first"
        if control is not None and control.picks and control.answer:
            if number == self.session.number:
                self._parts_about(number)[control.cue or 0] = control.answer[0]  # stored until the answer is sent
            return "" if number == self.session.number else LATE
        try:
            if control is not None and control.name == "undo":
                if await run.io_bound(self.session.undo, number):
                    return ""
                return "there is nothing to take back" if number == self.session.number else LATE
            answer = controls.answer_of(self.space, control, angle, self._parts if self._parts_of == number else {})
            return "" if await run.io_bound(self.session.answer, number, answer, seconds) else LATE
        except Exception as error:
            return str(error) or type(error).__name__

    def _script(self, code: str) -> None:
        with self._client:
            ui.run_javascript(code)

    async def _end(self) -> None:
        assert self._finish is not None
        try:
            await self._finish()
        except UserError as error:
            with self._client:
                ui.notify(str(error), type="negative", timeout=0, close_button="close")

    async def _show_film(self, of: str, number: int) -> None:
        """Play a film of an outcome of an item's action; of the action itself by default."""
        item, questions = self.session.item, self.session.questions
        if item is None or item.number != number:
            return
        action = item.refined if of == "refined" else questions.outcomes(item).get(of, item.action)
        if action is not None and (reel := await run.io_bound(questions.film, item, action)) is not None:
            self._script(f"cue.play({json.dumps({'item': number, **reel._asdict()})})")

    def goto(self, address: str) -> None:
        """Make the browser open another page of this server."""
        self._script(f"location.replace({json.dumps(address)})")

    def refresh(self) -> None:
        """Show the session's current state."""
        item = self.session.item
        how = self.form, self.session.plan.config.scalars.eps_deg, self.space
        if item is not self._item:  # chosen parts of an answer do not change the picture
            self._item = item
            self._scene.content = "" if item is None else view.picture(item, *how, self._one_cue)
            self._note.text = "" if item is None else view.note(item, *how)
        parts = self._parts_about(self.session.number)
        names = {one.name for one in self._picks if one.answer == (parts.get(one.cue or 0, UNSAID),)}
        for control, button in self._picks.items():  # highlights the parts chosen so far, where there are several cues
            button.classes(**{"add" if control.name in names else "remove": "picked"})
        if self._picks:
            self._script(f"cue.mark({json.dumps(sorted(names))})")
        if "film-refined" in self._tools:
            self._tools["film-refined"].set_visibility(item is not None and item.refined is not None)
        if item is None:
            self._question.text = "All labels are given. Thank you. Press finish, or undo to change the last one."
        else:
            self._question.text = controls.question(self.form, self.space)
            self._words.text = item.sketch.words if item.sketch else ""
        for button in self._pressable:
            button.set_enabled(item is not None)
        self._show_progress(self.session.status())

    def _parts_about(self, number: int) -> dict[int, float]:
        """Return the parts chosen for a question; empty for a new question."""
        if self._parts_of != number:
            self._parts, self._parts_of = {}, number
        return self._parts

    def _show_progress(self, status: Status) -> None:
        unsure = f", {status.unsure} not known" if status.unsure else ""
        self._count.text = f"{status.answered} of {status.labels}{unsure}"
        self._bar.value = status.answered / status.labels
        self._pace.text = f"{status.per_minute:.0f} labels a minute" if status.per_minute else "no labels yet"
        minutes, newest = status.minutes_left, status.newest
        self._minutes.text = f"{max(minutes, 1):.0f} min left" if minutes else ""
        what, doing = ("estimate", "reading") if self.session.plan.guidance.by_evidence else ("model", "fitting")
        state = f"{what} {newest.number}, of {newest.labels} labels" if newest.number else f"no {what} yet"
        now = newest.problem or (f"{doing} the next" if status.fitting else "")
        self._model.text = f"{state}; {now}" if now else state
        quality = f"agreement with held-out labels: {newest.quality}" if newest.quality else ""
        self._quality.text = "\n".join(newest.lines) or quality
        place = "/".join(self.session.record.path.parts[-2:])
        self._path.text = f"{place}: {status.answered + status.unsure} answers saved"
        self._trouble.text = status.trouble
        self._trouble.set_visibility(bool(status.trouble))
