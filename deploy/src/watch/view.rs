//! How a run looks on a terminal.

use super::model::{Curve, Model};
use crate::report::{TASKS_MAX, duration, ends, grouped, mean, printable, reasons, state, time_left, words};
use ratatui::{
    Frame,
    layout::{Constraint, Layout, Rect},
    style::{Color, Style, Stylize as _},
    text::{Line, Text},
    widgets::{Gauge, Paragraph, Row, Table},
};
use rit_proto::v1::{ActorStatus, Happening, RunState, RunStatus, TaskResult};

/// Draws all that is known. What does not fit is cut off from the bottom.
pub fn draw(frame: &mut Frame<'_>, model: &Model) {
    let status = &model.status;
    let rows = |count: usize| Constraint::Length(count as u16);
    let [head, bar, tasks, numbers, curves, actors, ledger, happenings] = Layout::vertical([
        rows(1),
        rows(2),
        rows(task_rows(status).len() + 2),
        rows(3),
        rows(model.curves.len() + 1),
        rows(status.actors.len() + 2),
        rows(3),
        Constraint::Fill(1),
    ])
    .areas(frame.area());
    frame.render_widget(header(model), head);
    frame.render_widget(progress(status), Rect { height: bar.height.min(1), ..bar });
    frame.render_widget(task_table(status), tasks);
    frame.render_widget(Text::from(numbers_of(status)), numbers);
    let width = (curves.width as usize).saturating_sub(32);
    frame.render_widget(Text::from_iter(model.curves.iter().map(|curve| curve_line(curve, width))), curves);
    frame.render_widget(actor_table(status), actors);
    frame
        .render_widget(Paragraph::new(ledger_of(status)).wrap(ratatui::widgets::Wrap { trim: true }), ledger);
    let shown = model.happenings.len().saturating_sub(happenings.height as usize);
    frame.render_widget(Text::from_iter(model.happenings.iter().skip(shown).map(happening)), happenings);
}

/// Something that happened, in a line.
pub fn happening(happening: &Happening) -> String {
    let steps = format!("{} steps", grouped(happening.env_steps));
    format!("{steps:>11}  {}", printable(&happening.what))
}

fn header(model: &Model) -> Line<'_> {
    let status = &model.status;
    let (word, colour) = match status.state() {
        _ if model.away => ("learner away", Color::Red),
        RunState::Running => (state(status), Color::Green),
        _ => (state(status), Color::Yellow),
    };
    let since = format!(" for {}, learner process {}", duration(status.wall_s), status.pid);
    Line::from_iter([
        model.name.as_str().bold(),
        "  ".into(),
        word.fg(colour).bold(),
        since.into(),
        "   q quits the view".dark_gray(),
    ])
}

fn progress(status: &RunStatus) -> Gauge<'static> {
    let share = status.env_steps as f64 / status.env_steps_max.max(1) as f64;
    let mut label =
        format!("{} of {} environment steps", grouped(status.env_steps), grouped(status.env_steps_max));
    label.extend(time_left(status).map(|left| format!(", {left} left")));
    Gauge::default().ratio(share.clamp(0.0, 1.0)).label(label).gauge_style(Style::new().blue().on_dark_gray())
}

/// Exploring and greedy results, task by task; of many tasks the mean, the lowest and the highest.
fn task_rows(status: &RunStatus) -> Vec<(TaskResult, Option<TaskResult>)> {
    let evaluated = status.evaluation.as_ref().map(|evaluation| &evaluation.tasks[..]).unwrap_or_default();
    let greedy = |task: &str| evaluated.iter().find(|result| result.task == task).cloned();
    let of_task = |result: &TaskResult| (result.clone(), greedy(&result.task));
    let mut rows: Vec<_> = ends(&status.recent).into_iter().map(of_task).collect();
    if status.recent.len() > TASKS_MAX {
        rows.insert(0, (mean(&status.recent), (!evaluated.is_empty()).then(|| mean(evaluated))));
    }
    rows
}

fn task_table(status: &RunStatus) -> Table<'static> {
    let share = |rate: Option<f64>| rate.map_or_else(|| "-".to_owned(), |rate| format!("{rate:.2}"));
    let rows = task_rows(status).into_iter().map(|(result, greedy)| {
        let number = |count: Option<u64>| count.map_or_else(|| "-".to_owned(), grouped);
        Row::new([
            result.task.clone(),
            format!("{:.2}", result.mean_return),
            share(result.win_rate),
            greedy.as_ref().map_or_else(|| "-".to_owned(), |greedy| format!("{:.2}", greedy.mean_return)),
            share(greedy.and_then(|greedy| greedy.win_rate)),
            number(result.episodes_total),
            number(result.policy_lag),
        ])
    });
    let widths = [16, 9, 9, 9, 9, 11, 4].map(Constraint::Length);
    let names = ["task", "return", "win rate", "greedy", "win rate", "episodes", "lag"];
    Table::new(rows, widths).header(Row::new(names).bold())
}

fn numbers_of(status: &RunStatus) -> Vec<Line<'static>> {
    let rates = status.rates.unwrap_or_default();
    let waited: f64 = status.actors.iter().map(|actor| actor.waiting_s).sum();
    vec![
        Line::from(format!(
            "{:.0} steps/s, {:.0} episodes/s, {:.0} updates/s; {} updates; epsilon {:.3}",
            rates.env_steps_per_s,
            rates.episodes_per_s,
            rates.updates_per_s,
            grouped(status.updates),
            status.epsilon
        )),
        Line::from(format!(
            "replay {} of {} episodes; waited: learner {}, actors {}",
            grouped(status.replay_episodes),
            grouped(status.replay_episodes_max),
            duration(status.learner_waiting_s),
            duration(waited)
        )),
    ]
}

fn curve_line(curve: &Curve, width: usize) -> Line<'static> {
    let newest = curve.values.back().map_or_else(|| "-".to_owned(), |value| format!("{value:.4}"));
    let name = words(&curve.name);
    Line::from_iter([format!("{name:18}{newest:>12}  ").into(), curve.sparkline(width).cyan()])
}

fn actor_table(status: &RunStatus) -> Table<'static> {
    let rows = status.actors.iter().map(|actor: &ActorStatus| {
        let (word, colour) = match actor {
            ActorStatus { hung: true, .. } => ("hung", Color::Red),
            ActorStatus { outstanding: 0, .. } => ("waiting", Color::Yellow),
            _ => ("rolling", Color::Green),
        };
        Row::new([
            Text::from(printable(&actor.name)),
            Text::from(actor.pid.to_string()),
            Text::from(word).fg(colour),
            Text::from(grouped(actor.episodes)),
            Text::from(grouped(actor.outstanding)),
            Text::from(duration(actor.waiting_s)),
        ])
    });
    let widths = [16, 9, 9, 11, 12, 12].map(Constraint::Length);
    let names = ["actor", "process", "state", "episodes", "outstanding", "waited"];
    Table::new(rows, widths).header(Row::new(names).bold())
}

fn ledger_of(status: &RunStatus) -> String {
    let ledger = status.ledger.clone().unwrap_or_default();
    let mut text = format!(
        "ledger: {} handed out = {} inserted + {} outstanding + {} taken back{}; frames refused: {}",
        grouped(ledger.handed_out),
        grouped(ledger.inserted),
        grouped(ledger.outstanding),
        grouped(ledger.rejected.values().sum()),
        reasons(&ledger.rejected).map_or_else(String::new, |words| format!(" ({words})")),
        grouped(ledger.frames_refused.values().sum())
    );
    if ledger.imbalances > 0 {
        text += "; IT DOES NOT BALANCE: a fault of the program";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratatui::{Terminal, backend::TestBackend};
    use rit_proto::v1::{Evaluation, LedgerStatus, Measure, MetricsLine, Rates, Training};

    fn model() -> Model {
        let result = |task: &str, mean_return, win_rate| TaskResult {
            task: task.into(),
            mean_return,
            win_rate,
            episodes_total: Some(1234),
            policy_lag: Some(1),
            ..TaskResult::default()
        };
        let actor = |name: &str, hung, outstanding| ActorStatus {
            name: name.into(),
            pid: 77,
            episodes: 2000,
            outstanding,
            hung,
            ..ActorStatus::default()
        };
        let mut model = Model::new("matrix-game-1".into());
        for step in 0..9 {
            let measure = Measure { name: "td_loss".into(), value: f64::from(step), ..Measure::default() };
            let training = Some(Training { measures: vec![measure], ..Training::default() });
            model.line(&MetricsLine { env_steps: 10, training, ..MetricsLine::default() });
        }
        model.status(RunStatus {
            state: RunState::Running.into(),
            env_steps: 25_000,
            env_steps_max: 50_000,
            wall_s: 62.0,
            pid: 42,
            recent: vec![result("game-1", 88.0, Some(0.5)), result("game-2", -3.25, Some(0.0))],
            evaluation: Some(Evaluation {
                tasks: vec![result("game-2", 94.0, Some(1.0))],
                ..Evaluation::default()
            }),
            rates: Some(Rates { env_steps_per_s: 2500.0, ..Rates::default() }),
            actors: vec![actor("actor-0", false, 3), actor("actor-1", true, 0)],
            ledger: Some(LedgerStatus { handed_out: 9, inserted: 5, outstanding: 4, ..Default::default() }),
            happenings: vec![Happening {
                what: "actor-0 joined".into(),
                wall_s: 1.0,
                ..Happening::default()
            }],
            ..RunStatus::default()
        });
        model
    }

    fn drawn(model: &Model, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| draw(frame, model)).unwrap();
        terminal.backend().to_string()
    }

    #[test]
    fn everything_is_on_a_screen_of_the_usual_size() {
        let screen = drawn(&model(), 80, 24);
        for part in [
            "matrix-game-1  running for 1 min 02 s, learner process 42",
            "25 000 of 50 000 environment steps, 10 s left",
            "game-1           88.00     0.50      -         -         1 234       1",
            "game-2           -3.25     0.00      94.00     1.00      1 234       1",
            "2500 steps/s",
            "td loss                 8.0000  ▁▂▃▄▅▅▆▇█",
            "actor-0          77        rolling   2 000       3",
            "actor-1          77        hung      2 000       0",
            "ledger: 9 handed out = 5 inserted + 4 outstanding + 0 taken back",
            "actor-0 joined",
        ] {
            assert!(screen.contains(part), "{part:?} in\n{screen}");
        }
    }

    #[test]
    fn a_small_screen_and_an_empty_model_do_no_harm() {
        for (width, height) in [(1, 1), (20, 5), (80, 10)] {
            drawn(&model(), width, height);
            drawn(&Model::new(String::new()), width, height);
        }
        let mut away = model();
        away.lost();
        assert!(drawn(&away, 80, 24).contains("learner away"));
    }
}
