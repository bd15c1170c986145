//! How the cells of a sweep stand, and what is left to do.

use super::log;
use crate::report;
use rit_config::{Config, RunDir};
use rit_record::{Cell, CellState, Ended, Progress, Summary, Sweep, TaskResult, last_progress};
use serde::Serialize;
use std::{collections::BTreeMap, path::Path};

/// How a cell stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Nothing is there of it yet.
    Waiting,
    /// Some process trains it.
    Running,
    /// It was killed, interrupted or stopped, and goes on from its newest checkpoint.
    Broken,
    /// It ended with an error; it is tried again by the next `rit sweep`.
    Failed,
    /// All is done.
    Finished,
}

impl State {
    /// In the order that they are told in.
    pub const ALL: [Self; 5] = [Self::Finished, Self::Running, Self::Broken, Self::Failed, Self::Waiting];

    pub const fn word(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Running => "running",
            Self::Broken => "broken off",
            Self::Failed => "failed",
            Self::Finished => "finished",
        }
    }
}

/// A cell and how it stands.
#[derive(Clone, Debug, Serialize)]
pub struct Standing {
    pub cell: String,
    pub state: State,
    pub env_steps: u64,
    pub env_steps_max: u64,
    /// Over training tasks, of the last evaluation.
    pub mean_return: Option<f64>,
    pub win_rate: Option<f64>,
    /// What it has taken.
    pub cpu_s: Option<f64>,
    /// What it will yet take, by what others took.
    pub cpu_left_s: Option<f64>,
    /// Why it failed.
    pub reason: Option<String>,
}

/// All cells, in their order.
pub fn of_all(dir: &Path, sweep: &Sweep, configs: &[Config]) -> Vec<Standing> {
    let mut standings: Vec<Standing> =
        sweep.cells.iter().zip(configs).map(|(cell, config)| of_cell(dir, cell, config)).collect();
    estimate(sweep, &mut standings);
    standings
}

/// Says of each cell what it will yet take.
pub fn estimate(sweep: &Sweep, standings: &mut [Standing]) {
    let costs = Costs::of(sweep, standings);
    for (cell, standing) in sweep.cells.iter().zip(standings) {
        let left = standing.env_steps_max.saturating_sub(standing.env_steps) as f64;
        let is_open = standing.state != State::Finished;
        standing.cpu_left_s = if is_open { costs.per_step(cell).map(|it| it * left) } else { Some(0.0) };
    }
}

/// One cell; what it will yet take is not known without the others.
pub fn of_cell(dir: &Path, cell: &Cell, config: &Config) -> Standing {
    let root = Sweep::run_dir(dir, cell);
    let mut standing = Standing {
        cell: cell.name.clone(),
        state: State::Waiting,
        env_steps: 0,
        env_steps_max: config.training.t_max,
        mean_return: None,
        win_rate: None,
        cpu_s: None,
        cpu_left_s: None,
        reason: None,
    };
    let run_dir = match (Sweep::state(dir, cell), RunDir::open(&root)) {
        (CellState::Waiting, _) => {
            // One that failed before it began has left nothing but its words.
            if let Some(reason) = log::last_words(dir, cell).filter(|words| words.starts_with(log::ERROR)) {
                standing.state = State::Failed;
                standing.reason = Some(reason.trim_start_matches(log::ERROR).to_owned());
            }
            return standing;
        }
        (_, Err(error)) => {
            (standing.state, standing.reason) = (State::Failed, Some(error.to_string()));
            return standing;
        }
        (_, Ok((run_dir, _))) => run_dir,
    };
    let in_use = run_dir.is_in_use();
    match Summary::read(&run_dir).ok().flatten() {
        // A process that has just been interrupted has written its summary and holds the run a moment longer.
        Some(summary) if summary.ended.is_whole() || !in_use => standing.take(&summary),
        _ => {
            standing.state = if in_use { State::Running } else { State::Broken };
            let Progress { env_steps, .. } = last_progress(&run_dir.metrics()).unwrap_or_default();
            standing.env_steps = env_steps;
        }
    }
    standing
}

impl Standing {
    fn take(&mut self, summary: &Summary) {
        self.state = match summary.ended {
            Ended::Finished | Ended::Until => State::Finished,
            Ended::Stopped | Ended::Interrupted => State::Broken,
            Ended::Failed => State::Failed,
        };
        self.env_steps = summary.progress.env_steps;
        self.cpu_s = summary.cpu_s;
        self.reason.clone_from(&summary.reason);
        let results: Vec<&TaskResult> = summary.evaluation.values().collect();
        let count = results.len() as f64;
        if !results.is_empty() {
            self.mean_return = Some(results.iter().map(|it| it.mean_return).sum::<f64>() / count);
            let wins: Option<f64> = results.iter().map(|it| it.win_rate).sum();
            self.win_rate = wins.map(|wins| wins / count);
        }
    }

    /// What it came to, in a few words.
    pub fn result(&self) -> String {
        match (self.mean_return, self.win_rate) {
            (Some(mean_return), Some(win_rate)) => format!("return {mean_return:.1}, win rate {win_rate:.2}"),
            (Some(mean_return), None) => format!("return {mean_return:.1}"),
            (None, _) => String::new(),
        }
    }
}

/// What an environment step has cost in cells that are finished, in CPU seconds.
#[derive(Default)]
struct Costs {
    /// By all settings but the seed.
    exact: BTreeMap<String, Vec<f64>>,
    /// By experiment and algorithm, and by experiment alone.
    alike: [BTreeMap<String, Vec<f64>>; 2],
}

fn keys(cell: &Cell) -> [String; 3] {
    let algorithm = cell.settings.get("algorithm.name").map_or("", String::as_str);
    [
        format!("{} {:?}", cell.experiment, cell.settings),
        format!("{} {algorithm}", cell.experiment),
        cell.experiment.clone(),
    ]
}

impl Costs {
    fn of(sweep: &Sweep, standings: &[Standing]) -> Self {
        let mut costs = Self::default();
        for (cell, standing) in sweep.cells.iter().zip(standings) {
            let Some(cpu_s) = standing.cpu_s.filter(|_| standing.state == State::Finished) else { continue };
            let cost = cpu_s / standing.env_steps.max(1) as f64;
            let [exact, with_algorithm, experiment] = keys(cell);
            costs.exact.entry(exact).or_default().push(cost);
            costs.alike[0].entry(with_algorithm).or_default().push(cost);
            costs.alike[1].entry(experiment).or_default().push(cost);
        }
        costs
    }

    /// The mean over the cells that are most like this one.
    fn per_step(&self, cell: &Cell) -> Option<f64> {
        let [exact, with_algorithm, experiment] = keys(cell);
        let found = self
            .exact
            .get(&exact)
            .or_else(|| self.alike[0].get(&with_algorithm))
            .or_else(|| self.alike[1].get(&experiment))?;
        Some(found.iter().sum::<f64>() / found.len() as f64)
    }
}

/// How many cells there are in each state, and what is left, in a line.
pub fn in_words(standings: &[Standing]) -> String {
    let count = |state| standings.iter().filter(|standing| standing.state == state).count();
    let counts = State::ALL.iter().filter(|&&state| count(state) > 0);
    let counts: Vec<_> = counts.map(|&state| format!("{} {}", count(state), state.word())).collect();
    format!("{} cells: {}{}", standings.len(), counts.join(", "), left_in_words(standings))
}

fn left_in_words(standings: &[Standing]) -> String {
    let open: Vec<&Standing> = standings.iter().filter(|it| it.state != State::Finished).collect();
    let known: Vec<f64> = open.iter().filter_map(|standing| standing.cpu_left_s).collect();
    match (open.len(), known.len()) {
        (0, _) => String::new(),
        (_, 0) => "; what they will take is known when one is finished".to_owned(),
        (all, known_count) => {
            let hours = known.iter().sum::<f64>() / 3600.0;
            let of = if all == known_count {
                String::new()
            } else {
                format!(" for {known_count} of the {all} open")
            };
            format!("; about {} CPU-hours left{of}", hours_in_words(hours))
        }
    }
}

fn hours_in_words(hours: f64) -> String {
    match hours {
        10.0.. => format!("{hours:.0}"),
        0.1.. => format!("{hours:.2}"),
        _ => format!("{hours:.4}"),
    }
}

/// A line a cell.
pub fn table(standings: &[Standing]) -> String {
    let width = standings.iter().map(|it| it.cell.len()).max().unwrap_or(0).max("cell".len());
    let mut text =
        format!("{:width$}  {:10}  {:>23}  {:>8}  {:>8}\n", "cell", "state", "steps", "CPU-h", "to go");
    for it in standings {
        let steps = format!("{} of {}", report::grouped(it.env_steps), report::grouped(it.env_steps_max));
        let hours =
            |seconds: Option<f64>| seconds.map_or_else(|| "-".to_owned(), |it| hours_in_words(it / 3600.0));
        let (taken, left) = (hours(it.cpu_s), hours(it.cpu_left_s.filter(|&left| left > 0.0)));
        let result = it.reason.as_deref().map_or_else(|| it.result(), report::printable);
        let line = format!(
            "{:width$}  {:10}  {steps:>23}  {taken:>8}  {left:>8}  {result}",
            it.cell,
            it.state.word()
        );
        text += line.trim_end();
        text.push('\n');
    }
    text + &in_words(standings) + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(algorithm: &str, seed: u64) -> Cell {
        Cell {
            name: format!("{algorithm}_seed-{seed}"),
            experiment: "matrix-game".into(),
            seed,
            settings: [("algorithm.name".to_owned(), algorithm.to_owned())].into(),
        }
    }

    fn standing(cell: &Cell, state: State, env_steps: u64, cpu_s: Option<f64>) -> Standing {
        Standing {
            cell: cell.name.clone(),
            state,
            env_steps,
            env_steps_max: 1000,
            mean_return: None,
            win_rate: None,
            cpu_s,
            cpu_left_s: None,
            reason: None,
        }
    }

    #[test]
    fn a_cells_cost_is_that_of_the_finished_ones_most_like_it() {
        let cells = vec![cell("rit", 1), cell("rit", 2), cell("mat", 1), cell("rit", 3)];
        let sweep = Sweep::new(vec!["algorithm.name".into()], cells);
        let states = [
            (State::Finished, 1000, Some(100.0)),
            (State::Finished, 1000, Some(300.0)),
            (State::Waiting, 0, None),
            // What failed says nothing of what a whole one takes.
            (State::Failed, 10, Some(900.0)),
        ];
        let standings: Vec<_> = sweep
            .cells
            .iter()
            .zip(states)
            .map(|(cell, (state, env_steps, cpu_s))| standing(cell, state, env_steps, cpu_s))
            .collect();
        let costs = Costs::of(&sweep, &standings);
        // (100 + 300) / 2 / 1000 for a step.
        assert_eq!(costs.per_step(&cell("rit", 9)), Some(0.2));
        assert_eq!(costs.per_step(&cell("mat", 9)), Some(0.2), "of the same experiment at least");
        let other = Cell { experiment: "predator-prey".into(), ..cell("rit", 1) };
        assert_eq!(costs.per_step(&other), None);
    }

    #[test]
    fn a_sweep_in_a_line() {
        let rit = cell("rit", 1);
        let mut all = vec![
            standing(&rit, State::Finished, 1000, Some(36.0)),
            standing(&rit, State::Broken, 500, None),
            standing(&rit, State::Waiting, 0, None),
        ];
        assert_eq!(
            in_words(&all),
            "3 cells: 1 finished, 1 broken off, 1 waiting; what they will take is known when one is finished"
        );
        (all[1].cpu_left_s, all[2].cpu_left_s) = (Some(18.0), Some(36.0));
        assert!(in_words(&all).ends_with("; about 0.0150 CPU-hours left"), "54 s are 0.015 h");
        all[2].cpu_left_s = None;
        assert!(
            in_words(&all).ends_with("about 0.0050 CPU-hours left for 1 of the 2 open"),
            "{}",
            in_words(&all)
        );
    }
}
