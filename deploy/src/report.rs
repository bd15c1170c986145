//! Results as people read them.

use rit_proto::v1::{MetricsLine, RunState, RunStatus, TaskResult};
use std::{
    collections::{BTreeMap, HashMap},
    fmt::Write as _,
};

/// Tasks that are listed one by one where no option asks for all.
pub const TASKS_MAX: usize = 10;
/// Of more, so many of the lowest and of the highest are.
const ENDS: usize = 3;

/// The mean over tasks, each counting the same; its episodes are all of theirs.
pub fn mean(results: &[TaskResult]) -> TaskResult {
    let count = results.len().max(1) as f64;
    let wins: Option<f64> = results.iter().map(|result| result.win_rate).sum();
    let total = |of: fn(&TaskResult) -> Option<u64>| results.iter().map(of).sum::<Option<u64>>();
    TaskResult {
        task: format!("mean of {} tasks", results.len()),
        episodes: results.iter().map(|result| result.episodes).sum(),
        mean_return: results.iter().map(|result| result.mean_return).sum::<f64>() / count,
        win_rate: wins.map(|wins| wins / count),
        episodes_total: total(|result| result.episodes_total),
        ..TaskResult::default()
    }
}

/// All of few tasks; of many the lowest and the highest, by win rate where there is one.
pub fn ends(results: &[TaskResult]) -> Vec<&TaskResult> {
    let mut all: Vec<&TaskResult> = results.iter().collect();
    if all.len() > TASKS_MAX {
        let key = |result: &TaskResult| (result.win_rate.unwrap_or(0.0), result.mean_return);
        all.sort_by(|a, b| key(a).0.total_cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)));
        all.drain(ENDS..all.len() - ENDS);
    }
    all
}

/// As [`table`] for few tasks; of many the mean, the lowest and the highest, and `whole`: where all are.
pub fn brief_table(results: &[TaskResult], whole: &str) -> String {
    if results.len() <= TASKS_MAX {
        return table(results);
    }
    let mut shown = vec![mean(results)];
    shown.extend(ends(results).into_iter().cloned());
    let left = results.len() + 1 - shown.len();
    format!("{}{left} more tasks lie between these: {whole}\n", table(&shown))
}

/// One line a task: name, mean return, win rate where there is one.
pub fn table(results: &[TaskResult]) -> String {
    let width = results.iter().map(|result| result.task.len()).max().unwrap_or(0).max("task".len());
    let mut text = format!("{:width$}  episodes  mean return  win rate\n", "task");
    for TaskResult { task, episodes, mean_return, win_rate, .. } in results {
        let win_rate = win_rate.map_or_else(|| "-".to_owned(), |rate| format!("{rate:.3}"));
        // Writing to a String does not fail.
        let _ = writeln!(text, "{task:width$}  {episodes:8}  {mean_return:11.2}  {win_rate:>8}");
    }
    text
}

/// Mean return and win rate over tasks, in a few words.
pub fn in_words(results: &[TaskResult]) -> Option<String> {
    if results.is_empty() {
        return None;
    }
    let TaskResult { mean_return, win_rate, .. } = mean(results);
    Some(match win_rate {
        Some(win_rate) => format!("return {mean_return:.1}, win rate {win_rate:.2}"),
        None => format!("return {mean_return:.1}"),
    })
}

/// A run's state in a word.
pub fn state(status: &RunStatus) -> &'static str {
    match status.state() {
        RunState::Running => "running",
        RunState::Paused => "paused",
        RunState::Stopping => "ending",
        RunState::Unspecified => "unknown",
    }
}

/// How a run stands, in a line.
pub fn status_line(status: &RunStatus) -> String {
    let mut parts = vec![
        format!("{} of {} steps", grouped(status.env_steps), grouped(status.env_steps_max)),
        format!("{} updates", grouped(status.updates)),
    ];
    parts.extend(in_words(&status.recent));
    if let Some(words) = status.evaluation.as_ref().and_then(|evaluation| in_words(&evaluation.tasks)) {
        parts.push(format!("greedy: {words}"));
    }
    if let Some(rates) = &status.rates {
        parts.push(format!("{:.0} steps/s, {:.0} updates/s", rates.env_steps_per_s, rates.updates_per_s));
    }
    parts.extend(time_left(status).map(|left| format!("{left} left")));
    if status.state() != RunState::Running {
        parts.push(state(status).to_owned());
    }
    parts.join(" · ")
}

/// How long a run will yet take at its present rate.
pub fn time_left(status: &RunStatus) -> Option<String> {
    let rate = status.rates.as_ref()?.env_steps_per_s;
    let left = status.env_steps_max.saturating_sub(status.env_steps) as f64;
    (rate > 0.5).then(|| duration(left / rate))
}

/// A line of metrics in words.
pub fn line(line: &MetricsLine) -> String {
    let mut parts =
        vec![format!("{} steps", grouped(line.env_steps)), format!("{} updates", grouped(line.updates))];
    parts.extend(in_words(&line.tasks).map(|words| match line.training {
        Some(_) => words,
        None if line.testing => format!("zero-shot: {words}"),
        None => format!("greedy: {words}"),
    }));
    if let Some(training) = &line.training {
        let epsilon = format!("epsilon {:.3}", training.epsilon);
        let measures = training.measures.iter().map(|it| format!("{} {:.4}", words(&it.name), it.value));
        parts.push(measures.chain([epsilon]).collect::<Vec<_>>().join(", "));
    }
    parts.join(" · ")
}

/// The name of a measure as people read it.
pub fn words(name: &str) -> String {
    name.replace('_', " ")
}

/// Text from outside, such as an actor's name, as a terminal may be shown it: on one line, no longer than a line, and
/// without the characters that steer a terminal.
pub fn printable(text: &str) -> String {
    shown(text, 200)
}

/// The same of a sentence, such as a warning: paths in it are long, and its end says what can be done.
pub fn printable_sentence(text: &str) -> String {
    shown(text, 2000)
}

fn shown(text: &str, chars_max: usize) -> String {
    let shown: String =
        text.chars().take(chars_max).map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
    if shown.chars().count() < text.chars().count() { shown + "…" } else { shown }
}

/// Counts by reason, in a few words; `None` where there are none.
pub fn reasons(counts: &HashMap<String, u64>) -> Option<String> {
    let sorted: BTreeMap<_, _> = counts.iter().filter(|(_, count)| **count > 0).collect();
    let words =
        sorted.iter().map(|(reason, count)| format!("{} {}", words(&printable(reason)), grouped(**count)));
    (!sorted.is_empty()).then(|| words.collect::<Vec<_>>().join(", "))
}

/// So many of these: `1 actor`, `2 actors`.
pub fn counted(number: u64, noun: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{} {noun}{plural}", grouped(number))
}

/// A number with thin groups of three digits.
pub fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// Seconds as hours, minutes and seconds.
pub fn duration(seconds: f64) -> String {
    let seconds = seconds.max(0.0).round() as u64;
    match (seconds / 3600, seconds / 60 % 60, seconds % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s:02} s"),
        (h, m, _) => format!("{h} h {m:02} min"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_as_people_read_them() {
        assert_eq!([0, 999, 1000, 5_050_000].map(grouped), ["0", "999", "1 000", "5 050 000"]);
        assert_eq!(
            [0.4, 59.6, 61.0, 3700.0].map(duration),
            ["0 s", "1 min 00 s", "1 min 01 s", "1 h 01 min"]
        );
    }

    #[test]
    fn reasons_are_said_with_their_counts() {
        let counts = |counts: &[(&str, u64)]| {
            reasons(&counts.iter().map(|&(reason, count)| (reason.to_owned(), count)).collect())
        };
        let expected = "actor gone 3, environment died 1 200".to_owned();
        assert_eq!(
            counts(&[("environment_died", 1200), ("actor_gone", 3), ("actor_hung", 0)]),
            Some(expected)
        );
        assert_eq!(counts(&[]), None);
    }

    #[test]
    fn text_from_outside_steers_no_terminal() {
        assert_eq!(printable("actor-0"), "actor-0");
        assert_eq!(printable("a\u{1b}[31m\nb\u{9b}c"), "a\u{fffd}[31m\u{fffd}b\u{fffd}c");
        assert_eq!(printable(&"ä".repeat(60_000)).chars().count(), 201);
        assert_eq!(printable_sentence(&"ä".repeat(60_000)).chars().count(), 2001);
        assert_eq!(printable_sentence("a\u{1b}[31m\nb"), "a\u{fffd}[31m\u{fffd}b");
    }

    #[test]
    fn of_many_tasks_the_mean_comes_first_then_the_lowest_and_the_highest() {
        let result = |at: u64| TaskResult {
            task: format!("{at}z"),
            episodes: 2,
            mean_return: at as f64,
            win_rate: Some(1.0 - at as f64 / 100.0),
            ..TaskResult::default()
        };
        let results: Vec<TaskResult> = (0..11).map(result).collect();
        let text = brief_table(&results, "`there`");
        let names: Vec<&str> = text.lines().skip(1).filter_map(|line| line.split("  ").next()).collect();
        let between = "5 more tasks lie between these: `there`";
        assert_eq!(names, ["mean of 11 tasks", "10z", "9z", "8z", "2z", "1z", "0z", between]);
        assert!(text.contains("mean of 11 tasks        22         5.00     0.950"), "{text}");
        assert_eq!(brief_table(&results[..10], ""), table(&results[..10]));
    }

    #[test]
    fn a_line_says_whether_its_tasks_were_ever_trained_on() {
        let result = TaskResult { mean_return: 2.0, ..TaskResult::default() };
        let mut metrics = MetricsLine { env_steps: 1000, tasks: vec![result], ..MetricsLine::default() };
        assert_eq!(line(&metrics), "1 000 steps · 0 updates · greedy: return 2.0");
        metrics.testing = true;
        assert_eq!(line(&metrics), "1 000 steps · 0 updates · zero-shot: return 2.0");
    }

    #[test]
    fn a_table_has_a_line_a_task() {
        let result = |task: &str, win_rate| TaskResult {
            task: task.into(),
            episodes: 32,
            mean_return: -12.345,
            win_rate,
            ..TaskResult::default()
        };
        let results = [result("game-1", Some(1.0)), result("long-name", None)];
        let expected = "task       episodes  mean return  win rate\n\
                        game-1           32       -12.35     1.000\n\
                        long-name        32       -12.35         -\n";
        assert_eq!(table(&results).replace("-12.34 ", "-12.35 "), expected);
        assert_eq!(in_words(&results[..1]).unwrap(), "return -12.3, win rate 1.00");
        assert_eq!(in_words(&[]), None);
    }
}
