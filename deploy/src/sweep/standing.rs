//! How the cells of a sweep stand, and what is left to do.

use super::{costs::Costs, plan::Plan};
use crate::report;
use rit_config::{Config, RunDir};
use rit_record::{Cell, CellState, Ended, Progress, Record, Summary, Sweep, TaskResult, last_progress};
use serde::Serialize;
use std::path::Path;

/// How a cell stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Nothing is there of it yet.
    Waiting,
    /// Some process trains it.
    Running,
    /// A process of another host trained it last: whether that lives, this one cannot know.
    Unknown,
    /// It was killed, interrupted or stopped, and goes on from its newest checkpoint.
    Broken,
    /// It ended with an error; it is tried again by the next `rit sweep`.
    Failed,
    /// A loss was no finite number, and would be again: it is left alone unless `--retry` asks for another try.
    Diverged,
    /// All is done.
    Finished,
}

impl State {
    /// In the order that they are told in.
    pub const ALL: [Self; 7] = [
        Self::Finished,
        Self::Running,
        Self::Unknown,
        Self::Broken,
        Self::Failed,
        Self::Diverged,
        Self::Waiting,
    ];

    pub const fn word(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Running => "running",
            Self::Unknown => "unknown",
            Self::Broken => "broken off",
            Self::Failed => "failed",
            Self::Diverged => "diverged",
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
    /// Whether these were of other methods or task sets.
    pub cpu_left_is_rough: bool,
    /// Why it failed.
    pub reason: Option<String>,
}

/// All cells, in their order.
pub fn of_all(dir: &Path, plan: &Plan) -> Vec<Standing> {
    let cells = plan.sweep.cells.iter().zip(&plan.configs);
    let mut standings: Vec<Standing> = cells.map(|(cell, config)| of_cell(dir, cell, config)).collect();
    estimate(plan, &[], &mut standings);
    standings
}

/// Says of each cell what it will yet take, by what the finished ones took and these records.
pub fn estimate(plan: &Plan, records: &[Record], standings: &mut [Standing]) {
    let mut costs = Costs::of(&plan.sweep, &plan.configs, standings);
    costs.add_records(records);
    for ((cell, config), standing) in plan.sweep.cells.iter().zip(&plan.configs).zip(standings) {
        let left = standing.env_steps_max.saturating_sub(standing.env_steps) as f64;
        if standing.state == State::Finished {
            standing.cpu_left_s = Some(0.0);
        } else if let Some(cost) = costs.per_step(cell, config) {
            standing.cpu_left_s = Some(cost.cpu_s * left);
            standing.cpu_left_is_rough = cost.is_rough;
        }
    }
}

/// One cell; what it will yet take is not known without the others.
pub fn of_cell(dir: &Path, cell: &Cell, config: &Config) -> Standing {
    let root = Sweep::run_dir(dir, cell);
    let mut standing = Standing::waiting(cell, config);
    let run_dir = match (Sweep::state(dir, cell), RunDir::open(&root)) {
        (CellState::Waiting, _) => {
            // One that failed before it began has left nothing but its words.
            if let Some(reason) = Sweep::failure(dir, cell) {
                (standing.state, standing.reason) = (State::Failed, Some(reason));
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
            if let Some(host) = run_dir.other_host().filter(|_| !in_use) {
                standing.state = State::Unknown;
                standing.reason = Some(format!("it is, or was killed, on another host, {host}"));
            }
            let Progress { env_steps, .. } = last_progress(&run_dir.metrics()).unwrap_or_default();
            standing.env_steps = env_steps;
        }
    }
    standing
}

impl Standing {
    /// Of a cell of which nothing is there.
    pub fn waiting(cell: &Cell, config: &Config) -> Self {
        Self {
            cell: cell.name.clone(),
            state: State::Waiting,
            env_steps: 0,
            env_steps_max: config.training.t_max,
            mean_return: None,
            win_rate: None,
            cpu_s: None,
            cpu_left_s: None,
            cpu_left_is_rough: false,
            reason: None,
        }
    }

    fn take(&mut self, summary: &Summary) {
        self.state = match summary.ended {
            Ended::Finished | Ended::Until => State::Finished,
            Ended::Stopped | Ended::Interrupted => State::Broken,
            Ended::Failed if summary.diverged => State::Diverged,
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

/// How many cells there are in each state, and what is left, in a line.
pub fn in_words(standings: &[Standing]) -> String {
    let count = |state| standings.iter().filter(|standing| standing.state == state).count();
    let counts = State::ALL.iter().filter(|&&state| count(state) > 0);
    let counts: Vec<_> = counts.map(|&state| format!("{} {}", count(state), state.word())).collect();
    format!("{} cells: {}{}", standings.len(), counts.join(", "), left_in_words(standings))
}

fn left_in_words(standings: &[Standing]) -> String {
    let is_open = |it: &&Standing| ![State::Finished, State::Diverged].contains(&it.state);
    let open: Vec<&Standing> = standings.iter().filter(is_open).collect();
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
            let rough = open.iter().filter(|standing| standing.cpu_left_is_rough).count();
            let by = if rough == 0 {
                String::new()
            } else {
                format!("; of {rough} by what other methods or task sets took")
            };
            format!("; about {} CPU-hours left{of}{by}", hours_in_words(hours))
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

    fn config(cell: &Cell) -> Config {
        super::super::plan::resolve(cell).unwrap()
    }

    fn standing(cell: &Cell, state: State, env_steps: u64, cpu_s: Option<f64>) -> Standing {
        Standing { state, env_steps, env_steps_max: 1000, cpu_s, ..Standing::waiting(cell, &config(cell)) }
    }

    #[test]
    fn a_cells_cost_is_that_of_the_finished_ones_most_like_it() {
        let navigation = Cell { experiment: "cooperative-navigation".into(), ..cell("rit", 1) };
        let pursuit = Cell { experiment: "predator-prey".into(), ..cell("rit", 1) };
        let combat = Cell { experiment: "3-8m".into(), ..cell("rit", 1) };
        let states = [
            (cell("rit", 1), State::Finished, 1000, Some(100.0)),
            (cell("rit", 2), State::Finished, 1000, Some(300.0)),
            (cell("mat", 1), State::Waiting, 0, None),
            // What failed says nothing of what a whole one takes.
            (cell("rit", 3), State::Failed, 10, Some(900.0)),
            (navigation, State::Finished, 1000, Some(500.0)),
            (pursuit, State::Waiting, 0, None),
            (combat.clone(), State::Waiting, 0, None),
        ];
        let mut standings: Vec<_> =
            states.iter().map(|(cell, state, steps, cpu_s)| standing(cell, *state, *steps, *cpu_s)).collect();
        let cells: Vec<Cell> = states.into_iter().map(|(cell, ..)| cell).collect();
        let configs = cells.iter().map(config).collect();
        let plan = Plan { sweep: Sweep::new(vec!["algorithm.name".into()], cells), configs };
        estimate(&plan, &[], &mut standings);
        let left = |at: usize| standings[at].cpu_left_s.map(|it| (it, standings[at].cpu_left_is_rough));
        // (100 + 300) / 2 / 1000 for a step; MAT's on the same task set are not known.
        assert_eq!((left(3), left(2)), (Some((198.0, false)), Some((200.0, true))));
        assert_eq!(
            (left(0), left(5)),
            (Some((0.0, false)), Some((500.0, true))),
            "of the same family at least"
        );
        assert_eq!(left(6), None);
        // A record that lies elsewhere says it.
        let settings = [("algorithm.name", "rit"), ("environment.task_set", "3-8m")];
        let record = Record {
            settings: settings.map(|(key, value)| (key.to_owned(), value.to_owned())).into(),
            progress: Progress { env_steps: 10, ..Progress::default() },
            cpu_s: Some(40.0),
            ended: Some(Ended::Finished),
            ..Record::default()
        };
        estimate(&plan, &[record], &mut standings);
        assert_eq!((standings[6].cpu_left_s, standings[6].cpu_left_is_rough), (Some(4000.0), false));
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
        all[1].cpu_left_is_rough = true;
        assert!(in_words(&all).ends_with("hours left; of 1 by what other methods or task sets took"));
        all[1].cpu_left_is_rough = false;
        all[2].cpu_left_s = None;
        assert!(
            in_words(&all).ends_with("about 0.0050 CPU-hours left for 1 of the 2 open"),
            "{}",
            in_words(&all)
        );
    }
}
