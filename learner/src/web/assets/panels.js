// Tiles, processes, ledger and log.

import { get } from "./feed.js";
import { byId, duration, grouped, make, short } from "./text.js";

/** An actor says something each second; so much later it is worth a look. */
const SILENT_S = 3;

const LOG_EVERY_MS = 2000;

export function showTiles(status, rates) {
  const rate = (value) => (rates ? grouped(value) : "–");
  const tiles = [
    ["Steps a second", rate(rates?.env_steps_per_s)],
    ["Updates a second", rates ? short(rates.updates_per_s) : "–"],
    ["Episodes", grouped(status.episodes)],
    ["Updates", grouped(status.updates)],
    ["Episodes in replay", grouped(status.replay_episodes)],
    ["ε", status.epsilon.toFixed(3)],
    ["Learner up", duration(status.wall_s)],
  ];
  byId("tiles").replaceChildren(
    ...tiles.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))),
  );
}

/** What the learner says aloud, the newest first. */
export function showWarnings({ happenings }) {
  const warnings = happenings.filter(({ warning }) => warning).reverse();
  byId("warnings").hidden = warnings.length === 0;
  byId("warnings").replaceChildren(
    ...warnings.map(({ env_steps, what }) => make("li", {}, make("b", {}, `${grouped(env_steps)} steps`), ` ${what}`)),
  );
}

function actorState({ hung, silent_s, outstanding }, paused) {
  if (hung) return ["hung", "bad"];
  if (silent_s > SILENT_S) return ["silent", "warn"];
  if (outstanding > 0) return ["rolling", "good"];
  return [paused ? "paused" : "waiting", ""];
}

export function showProcesses(status, over) {
  const row = (name, [state, look], id, episodes, outstanding, silent) => {
    const number = (text) => make("td", { class: "n" }, text);
    const pill = make("td", {}, make("span", { class: `pill ${look}` }, state));
    return make("tr", {}, make("th", {}, name), pill, number(String(id)), number(episodes), number(outstanding), number(silent));
  };
  const looks = { running: "good", paused: "warn", stopping: "warn" };
  const byName = (a, b) => a.name.localeCompare(b.name, undefined, { numeric: true });
  const actors = status.actors.toSorted(byName).map((actor) => {
    const state = over ? ["ended", ""] : actorState(actor, status.state === "paused");
    return row(actor.name, state, actor.pid, grouped(actor.episodes), grouped(actor.outstanding), `${actor.silent_s.toFixed(1)} s`);
  });
  byId("processes").replaceChildren(
    row("learner", over ? ["ended", ""] : [status.state, looks[status.state] ?? ""], status.pid, grouped(status.episodes), "", ""),
    ...actors,
  );
}

export function showLedger({ handed_out, inserted, outstanding, rejected, frames_refused }) {
  const takenBack = Object.values(rejected).reduce((sum, count) => sum + count, 0);
  const parts = [
    ["inserted", inserted, 2],
    ["outstanding", outstanding, 0],
    ["taken back", takenBack, 1],
  ];
  const bar = make("div", { class: "bar" });
  for (const [, count, colour] of parts) {
    const part = make("span", { class: `c${colour}` });
    part.style.flexGrow = count;
    bar.append(part);
  }
  const rows = [["handed out", handed_out, null], ...parts].map(([name, count, colour]) =>
    make("div", {}, make("dt", {}, ...(colour === null ? [] : [make("i", { class: `swatch c${colour}` })]), name), make("dd", {}, grouped(count))),
  );
  const reasons = (title, counts) => {
    const all = Object.entries(counts).map(([name, count]) => `${name.replaceAll("_", " ")} ${grouped(count)}`);
    return make("p", { class: "note" }, `${title}: ${all.join(", ") || "none"}`);
  };
  byId("ledger").replaceChildren(
    bar,
    make("dl", {}, ...rows),
    reasons("Taken back", rejected),
    reasons("Frames refused", frames_refused),
  );
}

/** Follows the log of the process that is chosen. */
export function followLog() {
  const select = byId("log-process");
  const pre = byId("log");
  let shown = null;
  const look = async () => {
    if (document.hidden) return;
    const process = select.value || "learner";
    const { processes, text } = await get(`/api/log?process=${encodeURIComponent(process)}`);
    if (processes.join() !== [...select.options].map((option) => option.value).join()) {
      select.replaceChildren(...processes.map((name) => make("option", { value: name }, name)));
      select.value = process;
    }
    const atEnd = shown !== process || pre.scrollTop + pre.clientHeight >= pre.scrollHeight - 4;
    if (pre.textContent !== text) pre.textContent = text || "nothing yet";
    if (atEnd) pre.scrollTop = pre.scrollHeight;
    shown = process;
  };
  // A learner that does not answer is said elsewhere.
  const again = () => look().catch(() => {});
  select.addEventListener("change", again);
  setInterval(again, LOG_EVERY_MS);
  again();
}
