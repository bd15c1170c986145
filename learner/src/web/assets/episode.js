// One episode, rolled on request and played back: bodies, trails, decision order, actions and rewards.

import { post } from "./feed.js";
import { byId, draw, grouped, make, short } from "./text.js";

/** What an action looks like: the way it pushes, or what it is called. */
const arrow = ([dx, dy]) => (dx < 0 ? "←" : dx > 0 ? "→" : dy < 0 ? "↓" : dy > 0 ? "↑" : "•");
/** Actions of combat from this one on are attacks and heals. */
const FIRST_TARGET = 6;

const ORDINALS = ["1st", "2nd", "3rd"];
const ordinal = (k) => ORDINALS[k] ?? `${k + 1}th`;

/** Action 0, 1, … of a matrix game: a¹, a², … */
const matrixAction = (action) => `a${"¹²³⁴⁵⁶⁷⁸⁹"[action] ?? action + 1}`;

export class EpisodeView {
  #episode = null;
  /** Where the playback stands, in steps: between two of them bodies are drawn between two scenes. */
  #time = 0;
  #playing = false;
  #frame = 0;

  constructor({ training_tasks, testing_tasks }, complain) {
    this.complain = complain;
    this.play = byId("episode-play");
    this.scrub = byId("episode-scrub");
    const group = (label, names) =>
      make("optgroup", { label }, ...names.map((name) => make("option", { value: name }, name)));
    byId("episode-task").append(
      group("training", training_tasks),
      ...(testing_tasks.length ? [group("testing, never trained on", testing_tasks)] : []),
    );
    byId("episode-task").value = training_tasks.at(-1);
    byId("episode-roll").addEventListener("click", () => this.#roll());
    byId("episode-task").addEventListener("change", () => {
      byId("episode-number").value = 0;
      this.#episode && this.#roll();
    });
    this.play.addEventListener("click", () => (this.#playing ? this.#pause() : this.#start()));
    this.scrub.addEventListener("input", () => {
      this.#pause();
      this.#show(Number(this.scrub.value));
    });
  }

  /** Whether the learner is there to roll. */
  set enabled(enabled) {
    byId("episode-roll").disabled = !enabled;
  }

  async #roll() {
    const button = byId("episode-roll");
    const number = byId("episode-number");
    button.disabled = true;
    button.textContent = "Rolling…";
    try {
      const episode = await post("/api/watch", { task: byId("episode-task").value, number: Number(number.value) });
      this.#load(episode);
      number.value = episode.number + 1;
    } catch (error) {
      this.complain(error.message);
    }
    button.textContent = "Roll";
    button.disabled = false;
  }

  #load(episode) {
    this.#pause();
    this.#episode = episode;
    this.steps = episode.rewards.length;
    this.soFar = episode.rewards.reduce((sums, reward) => [...sums, sums.at(-1) + reward], [0]);
    this.scrub.max = this.steps;
    this.scrub.disabled = this.play.disabled = false;
    this.#buildRewards();
    if (episode.scenes.length) this.#buildStage();
    else this.#buildTable();
    byId("episode-weights").textContent = `no. ${episode.number} · weights ${grouped(episode.weights_version)}`;
    byId("episode-weights").title = `the newest when it was rolled, at ${grouped(episode.env_steps)} environment steps`;
    this.#show(0);
    byId("episode").dataset.episode = `${episode.task} ${episode.number}`;
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.#start();
  }

  #start() {
    if (this.#time >= this.steps) this.#show(0);
    this.#playing = true;
    this.#label();
    let before = null;
    const next = (now) => {
      if (!this.#playing) return;
      const passed = (now - (before ?? now)) / 1000;
      const time = this.#time + passed * Number(byId("episode-speed").value);
      before = now;
      this.#show(Math.min(time, this.steps));
      if (this.#time >= this.steps) this.#pause();
      else this.#frame = requestAnimationFrame(next);
    };
    this.#frame = requestAnimationFrame(next);
  }

  #pause() {
    this.#playing = false;
    cancelAnimationFrame(this.#frame);
    this.#label();
  }

  #label() {
    this.play.textContent = this.#playing ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", this.#playing ? "Pause the episode" : "Play");
  }

  /** A window on all that happens, and an element for each body. */
  #buildStage() {
    const { scenes } = this.#episode;
    const reach = (of) => {
      const all = scenes.flat().flatMap((body) => [body[of] - body.radius, body[of] + body.radius]);
      return [Math.min(...all), Math.max(...all)];
    };
    const [[x0, x1], [y0, y1]] = [reach("x"), reach("y")];
    const { clientWidth, clientHeight } = byId("episode-stage");
    /** One pixel in the world's measure. */
    this.unit = Math.max((x1 - x0) / clientWidth, (y1 - y0) / clientHeight, 2 / clientHeight) * 1.12;
    const [width, height] = [clientWidth * this.unit, clientHeight * this.unit];
    // Screens count y downwards, worlds upwards.
    const [left, top] = [(x0 + x1 - width) / 2, -(y0 + y1 + height) / 2];
    this.svg = draw("svg", { viewBox: `${left} ${top} ${width} ${height}`, role: "img", "aria-label": "The episode's world" });
    this.#buildGrid(left, top, width, height);
    this.bodies = scenes[0].map((body, index) => {
      const agent = body.kind === "agent";
      const look = agent ? `agent c${index % 6}` : body.kind;
      const trail = draw("polyline", { class: `trail ${look}`, "stroke-width": 1.6 * this.unit });
      const circle = draw("circle", { class: look, r: body.radius, "stroke-width": 1.2 * this.unit });
      const push = draw("line", { class: `push ${look}`, "stroke-width": 2.4 * this.unit });
      const text = (agent ? String(index + 1) : "") + (body.unit?.letter ?? "");
      const roomy = body.radius > 7 * this.unit;
      const beside = { class: `label beside ${look}`, "font-size": 11 * this.unit, y: -body.radius - 4 * this.unit };
      const inside = { class: "label", "font-size": body.radius * 1.1, dy: "0.36em" };
      const label = draw("text", { ...(roomy ? inside : beside), "text-anchor": "middle" }, text);
      const bars = body.unit ? this.#buildVitals(body) : [];
      const place = draw("g", {}, push, circle, label, ...bars.flatMap(({ back, bar }) => [back, bar]));
      return { index, kind: body.kind, radius: body.radius, trail, place, push, bars };
    });
    this.links = draw("g", { class: "links", "stroke-width": 1.4 * this.unit });
    const layer = (kinds) => this.bodies.filter(({ kind }) => kinds.includes(kind));
    this.svg.append(
      ...layer(["landmark"]).map(({ place }) => place),
      ...layer(["agent", "prey", "enemy"]).map(({ trail }) => trail),
      this.links,
      ...layer(["prey", "enemy", "agent"]).map(({ place }) => place),
    );
    byId("episode-stage").replaceChildren(this.svg);
    this.table = null;
  }

  /** Bars of health and shield above a unit. */
  #buildVitals({ radius, unit }) {
    const width = Math.max(2 * radius, 12 * this.unit);
    const height = 2.5 * this.unit;
    const kinds = unit.shield === null ? ["health"] : ["health", "shield"];
    return kinds.map((of, row) => {
      const y = -radius - (row + 1) * (height + this.unit) - this.unit;
      const shape = { x: -width / 2, y, height };
      return { of, width, back: draw("rect", { ...shape, width, class: "lost" }), bar: draw("rect", { ...shape, width, class: of }) };
    });
  }

  /** Lines half a unit of the world apart, or more where that would be too many. */
  #buildGrid(left, top, width, height) {
    const grid = draw("g", { class: "grid", "stroke-width": this.unit });
    const pitch = [0.5, 1, 2, 5, 10].find((pitch) => width / pitch <= 16) ?? 20;
    for (let x = Math.ceil(left / pitch) * pitch; x < left + width; x += pitch) {
      grid.append(draw("line", { x1: x, x2: x, y1: top, y2: top + height }));
    }
    for (let y = Math.ceil(top / pitch) * pitch; y < top + height; y += pitch) {
      grid.append(draw("line", { x1: left, x2: left + width, y1: y, y2: y }));
    }
    this.svg.append(grid);
  }

  /** Where entities have no places: what each agent did at each step. */
  #buildTable() {
    const { actions, rewards, decision_order, won } = this.#episode;
    const heads = decision_order.map((_, agent) => make("th", {}, `agent ${agent + 1}`));
    this.table = actions.map((joint, step) =>
      make("tr", {}, make("th", {}, String(step + 1)), ...joint.map((action) => make("td", {}, matrixAction(action))), make("td", { class: "n" }, short(rewards[step]))),
    );
    const head = make("tr", {}, make("th", {}, "step"), ...heads, make("th", { class: "n" }, "reward"));
    const verdict = won === null ? [] : [make("p", { class: `pill ${won ? "good" : ""}` }, won ? "won" : "not won")];
    byId("episode-stage").replaceChildren(
      make("div", { class: "steps" }, make("table", {}, make("thead", {}, head), make("tbody", {}, ...this.table)), ...verdict),
    );
    this.svg = null;
  }

  #buildRewards() {
    const { rewards } = this.#episode;
    const [low, high] = [Math.min(0, ...rewards), Math.max(0, ...rewards)];
    const y = (reward) => ((high - reward) / (high - low || 1)) * 40;
    this.bars = rewards.map((reward, step) =>
      draw("rect", { x: step + 0.12, width: 0.76, y: Math.min(y(0), y(reward)), height: Math.max(0.5, Math.abs(y(reward) - y(0))) }),
    );
    const svg = draw("svg", { viewBox: `0 0 ${this.steps} 40`, preserveAspectRatio: "none", role: "img", "aria-label": "Reward of each step" });
    svg.append(...this.bars);
    byId("episode-rewards").replaceChildren(svg);
  }

  #show(time) {
    this.#time = time;
    const step = Math.min(Math.floor(time), this.steps);
    this.scrub.value = step;
    byId("episode").dataset.step = step;
    if (this.svg) this.#placeBodies(time, step);
    this.table?.forEach((row, at) => row.classList.toggle("past", at < Math.ceil(time)));
    this.bars.forEach((bar, at) => bar.classList.toggle("past", at < Math.ceil(time)));
    this.#showOrder(step);
    this.#showCaption(step);
  }

  #placeBodies(time, step) {
    const { scenes, actions, links, pushes } = this.#episode;
    const next = Math.min(step + 1, this.steps);
    const part = time - step;
    this.links.replaceChildren(
      ...links[next].map(({ from, to, heals }) => {
        const [a, b] = [scenes[step][from], scenes[next][to]];
        return draw("line", { class: heals ? "heal" : "attack", x1: a.x, y1: -a.y, x2: b.x, y2: -b.y });
      }),
    );
    for (const { index, kind, radius, trail, place, push, bars } of this.bodies) {
      const [from, to] = [scenes[step][index], scenes[next][index]];
      const [x, y] = [from.x + (to.x - from.x) * part, -(from.y + (to.y - from.y) * part)];
      place.setAttribute("transform", `translate(${x} ${y})`);
      for (const { of, width, bar } of bars) bar.setAttribute("width", width * Math.max(0, to.unit[of]));
      place.classList.toggle("dead", to.unit?.health <= 0);
      trail.classList.toggle("dead", to.unit?.health <= 0);
      const past = scenes.slice(0, step + 1).map((scene) => `${scene[index].x},${-scene[index].y}`);
      trail.setAttribute("points", [...past, `${x},${y}`].join(" "));
      if (kind !== "agent") continue;
      const [dx, dy] = step < this.steps ? pushes[actions[step][index]] : [0, 0];
      const length = radius + 9 * this.unit;
      push.setAttribute("x2", dx * length);
      push.setAttribute("y2", -dy * length);
    }
  }

  #showOrder(step) {
    const { decision_order, actions, scenes, pushes } = this.#episode;
    const fights = scenes.length && scenes[0][0].unit;
    const told = (action) =>
      !scenes.length ? matrixAction(action) : fights && action >= FIRST_TARGET ? `×${action - FIRST_TARGET}` : arrow(pushes[action]);
    const joint = actions[Math.min(step, this.steps - 1)];
    const chips = decision_order.map((agent, k) =>
      make("li", {}, make("span", { class: "note" }, ordinal(k)), make("i", { class: `dot c${agent % 6}` }, String(agent + 1)), told(joint[agent])),
    );
    byId("episode-order").replaceChildren(...chips);
  }

  #showCaption(step) {
    const { rewards } = this.#episode;
    const reward = step > 0 ? ` · reward ${short(rewards[step - 1])}` : "";
    byId("episode-caption").textContent = `Step ${step} of ${this.steps}${reward} · so far ${short(this.soFar[step])}`;
  }
}
