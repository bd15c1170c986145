// The page: what the learner sends goes into panels and charts, buttons go back to it.

import { Chart } from "./chart.js";
import { EpisodeView } from "./episode.js";
import { get, listen, post } from "./feed.js";
import { followLog, showLedger, showProcesses, showTiles, showWarnings } from "./panels.js";
import { byId, duration, grouped, make, short } from "./text.js";

const NOTE_MS = 8000;
/** So many tasks have a line each; of more their mean is drawn, and tasks that are asked for. */
const TASKS_MAX = 6;

const run = await get("/api/run");
const episode = new EpisodeView(run, (text) => note(text, "bad"));
/** Lines of metrics.jsonl by kind; `testing` are evaluations of tasks that are never trained on. */
const lines = { training: [], evaluation: [], testing: [] };
/** Tasks that are drawn beside the mean: name and colour. */
const shown = new Map();
let link = "lost";
let status = null;

const curve = new Chart(byId("curve"), { label: "Learning curves" });
/** Small charts: key in a training line, and what it is called. */
const smallCharts = [...run.measures.map(({ name, help }) => [name, help]), ...(run.explores ? [["epsilon", "Exploration ε"]] : [])];
const small = smallCharts.map(([key, name]) => {
  const box = make("div", { class: "chart" });
  byId("small-charts").append(make("section", { class: "card" }, make("h2", {}, name), box));
  return { key, name, chart: new Chart(box, { label: name, compact: true, range: key === "epsilon" ? [0, 1] : null }) };
});

function note(text, look = "") {
  const element = make("p", { class: look }, text);
  byId("notes").append(element);
  setTimeout(() => element.remove(), NOTE_MS);
}

const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;

function drawCurves() {
  const [kind, measure] = [chosen("kind"), chosen("measure")];
  const names = kind === "testing" ? run.testing_tasks : run.training_tasks;
  const of = (name, colour) => ({
    name,
    colour,
    points: lines[kind].filter(({ tasks }) => tasks[name]).map(({ env_steps, tasks }) => [env_steps, tasks[name][measure]]),
  });
  const many = names.length > TASKS_MAX;
  const series = many
    ? [meanOf(names, lines[kind], measure), ...names.filter((name) => shown.has(name)).map((name) => of(name, shown.get(name)))]
    : names.map(of);
  curve.range = measure === "win_rate" ? [0, 1] : null;
  curve.show(series, kind === "training" ? "The first point is still to come" : "The first evaluation is still to come");
  showTaskList(many ? names : [], lines[kind].at(-1)?.tasks ?? {}, measure);
  byId("curve-legend").replaceChildren(
    ...series.map(({ name, colour, points }) =>
      make("li", {}, make("i", { class: `swatch c${colour}` }), name, make("b", {}, points.length ? short(points.at(-1)[1]) : "–")),
    ),
  );
}

/** The mean over the tasks that a line has. */
function meanOf(names, points, measure) {
  const mean = ({ tasks }) => {
    const values = names.filter((name) => tasks[name]).map((name) => tasks[name][measure]);
    return values.reduce((sum, value) => sum + value, 0) / values.length;
  };
  const there = points.filter(({ tasks }) => names.some((name) => tasks[name]));
  return { name: `mean of ${names.length} tasks`, colour: 0, points: there.map((line) => [line.env_steps, mean(line)]) };
}

/** Each of many tasks with its newest value; those that are ticked are drawn, as many as there are colours. */
function showTaskList(names, newest, measure) {
  byId("curve-tasks").hidden = names.length === 0;
  const list = byId("curve-task-list");
  if (list.dataset.names !== names.join()) {
    list.dataset.names = names.join();
    list.replaceChildren(...names.map((name) => make("li", {}, make("label", {}, tick(name), ` ${name} `, make("b", {})))));
  }
  const full = shown.size >= TASKS_MAX - 1;
  for (const [at, name] of names.entries()) {
    const item = list.children[at];
    const box = item.querySelector("input");
    box.checked = shown.has(name);
    box.disabled = full && !box.checked;
    item.querySelector("b").textContent = newest[name] ? short(newest[name][measure]) : "–";
  }
}

function tick(name) {
  const box = make("input", { type: "checkbox" });
  box.addEventListener("change", () => {
    const taken = new Set(shown.values());
    const free = [...Array(TASKS_MAX).keys()].find((colour) => colour > 0 && !taken.has(colour));
    if (!box.checked) shown.delete(name);
    else if (free) shown.set(name, free);
    drawCurves();
  });
  return box;
}

function drawSmall() {
  for (const { key, name, chart } of small) {
    chart.show([{ name, colour: 0, points: lines.training.map((line) => [line.env_steps, line[key]]) }], "–");
  }
}

/** Among what it is drawn; nothing for evaluations of the best weights, which are no point of a curve. */
function kindOf({ kind, split, occasion }) {
  if (occasion === "best") return null;
  return kind === "evaluation" && split === "testing" ? "testing" : kind;
}

function redraw() {
  drawCurves();
  drawSmall();
}

function showStatus() {
  const state = link === "live" ? status.state : { lost: "no answer", over: "ended" }[link];
  const look = { running: "good", paused: "warn", stopping: "warn", "no answer": "bad" }[state] ?? "";
  byId("state").textContent = state;
  byId("state").className = `pill ${look}`;
  document.title = `${state} · ${run.name} · RIT`;
  const live = link === "live" && state !== "stopping";
  byId("pause").textContent = state === "paused" ? "Resume" : "Pause";
  for (const id of ["pause", "evaluate", "checkpoint", "stop"]) byId(id).disabled = !live;
  episode.enabled = live;
  document.body.classList.toggle("stale", link !== "live");
  if (!status) return;
  const speed = state === "running" ? status.rates : null;
  const share = Math.min(1, status.env_steps / status.env_steps_max);
  byId("progress").value = share;
  byId("progress-steps").textContent =
    `${grouped(status.env_steps)} of ${grouped(status.env_steps_max)} steps, ${Math.floor(share * 100)} %`;
  const left = (status.env_steps_max - status.env_steps) / speed?.env_steps_per_s;
  byId("progress-left").textContent = speed?.env_steps_per_s > 0.5 ? `${duration(left)} left` : "";
  showWarnings(status);
  showTiles(status, speed);
  showProcesses(status, link === "over");
  showLedger(status.ledger);
}

/** Does what a button wants; what goes wrong is said. */
const onClick = (id, work) =>
  byId(id).addEventListener("click", async () => {
    try {
      await work();
    } catch (error) {
      note(error.message, "bad");
    }
  });

const change = async (what) => {
  status = await post(`/api/${what}`);
  showStatus();
};

function setUpButtons() {
  onClick("pause", () => change(status.state === "paused" ? "resume" : "pause"));
  onClick("checkpoint", async () => {
    const { path, env_steps } = await post("/api/checkpoint");
    note(`Checkpoint at ${grouped(env_steps)} steps: ${path}`);
  });
  onClick("stop", () => byId("stop-dialog").showModal());
  onClick("stop-cancel", () => byId("stop-dialog").close());
  onClick("stop-confirm", async () => {
    byId("stop-dialog").close();
    await change("stop");
  });
}

function setUpEvaluate() {
  const option = (value, text = value) => make("option", { value }, text);
  byId("evaluate-tasks").append(
    option("training", "all training tasks"),
    ...(run.testing_tasks.length ? [option("testing", "all testing tasks")] : []),
    ...[...run.training_tasks, ...run.testing_tasks].map((name) => option(name)),
  );
  const own = () => {
    const task = byId("evaluate-tasks").value;
    const testing = task === "testing" || run.testing_tasks.includes(task);
    byId("evaluate-episodes").value = testing ? run.testing_episodes : run.evaluation_episodes;
  };
  byId("evaluate-tasks").addEventListener("change", own);
  own();
  onClick("evaluate", () => byId("evaluate-dialog").showModal());
  onClick("evaluate-close", () => byId("evaluate-dialog").close());
  onClick("evaluate-go", async () => {
    const go = byId("evaluate-go");
    go.disabled = true;
    byId("evaluate-result").textContent = "Rolling…";
    try {
      const tasks = [byId("evaluate-tasks").value];
      showEvaluation(await post("/api/evaluate", { tasks, episodes: Number(byId("evaluate-episodes").value) }));
    } catch (error) {
      byId("evaluate-result").textContent = error.message;
    }
    go.disabled = false;
  });
}

function showEvaluation({ env_steps, weights_version, tasks }) {
  const number = (text) => make("td", { class: "n" }, text);
  const head = ["Task", "Episodes", "Mean return", ...(run.has_wins ? ["Win rate"] : [])];
  const rows = tasks.map(({ task, episodes, mean_return, win_rate }) =>
    make("tr", {}, make("th", {}, task), number(grouped(episodes)), number(short(mean_return)), ...(run.has_wins ? [number(win_rate.toFixed(3))] : [])),
  );
  const heads = head.map((text, at) => make("th", at ? { class: "n" } : {}, text));
  byId("evaluate-result").replaceChildren(
    make("p", { class: "note" }, `Weights ${grouped(weights_version)} at ${grouped(env_steps)} steps`),
    make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows)),
  );
}

function setUpCurves() {
  for (const [name, standard] of [["kind", "training"], ["measure", "mean_return"]]) {
    const stored = localStorage.getItem(name);
    const isThere = ({ value }) => value !== "testing" || run.testing_tasks.length > 0;
    const radios = [...document.querySelectorAll(`input[name=${name}]`)].filter(isThere);
    const first = radios.find(({ value }) => value === stored) ?? radios.find(({ value }) => value === standard);
    first.checked = true;
    for (const radio of radios) {
      radio.addEventListener("change", () => {
        localStorage.setItem(name, radio.value);
        drawCurves();
      });
    }
  }
  byId("kind-testing").hidden = run.testing_tasks.length === 0;
  if (run.has_wins) byId("curve-measure").hidden = false;
  else document.querySelector("input[value=mean_return]").checked = true;
}

byId("run-name").textContent = run.name;
byId("run-where").textContent = run.task_set;
byId("run-where").title = run.directory;
byId("config").textContent = run.config;
setUpButtons();
setUpEvaluate();
setUpCurves();
redraw();
followLog();
listen({
  reset() {
    lines.training = [];
    lines.evaluation = [];
    lines.testing = [];
  },
  metrics(news) {
    for (const line of news) lines[kindOf(line)]?.push(line);
    redraw();
  },
  status(news) {
    status = news;
    showStatus();
  },
  link(state) {
    link = state;
    if (state !== "live") showStatus();
  },
});
