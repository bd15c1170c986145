//! `rit evaluate`: greedy episodes with a run's weights or a script, in this process.

use crate::{cli::EvaluateOptions, failure::Failure, output, player::Player};
use rit_learner::evaluation::Evaluator;
use rit_record::TaskResult;
use serde_json::{Map, Value, json};
use std::{fmt::Write as _, process::ExitCode};

/// `rit evaluate`.
pub fn run(options: &EvaluateOptions) -> Result<ExitCode, Failure> {
    let mut player = Player::new(&options.play)?;
    let config = &player.config;
    let evaluator = Evaluator::new(config);
    let tasks = evaluator.tasks(&options.tasks)?;
    let episodes = options.episodes.map(|episodes| episodes as usize);
    let seed = player.seed(options.seed);
    let results = evaluator.evaluate(&mut [player.policy.as_mut()], &tasks, episodes, seed)?;
    if options.json {
        let tasks = results.iter().map(|result| Ok((result.task.clone(), in_json(result)?)));
        let tasks = tasks.collect::<Result<Map<_, _>, serde_json::Error>>().map_err(Failure::runtime)?;
        let answer = json!({
            "policy": player.name,
            "weights_digest": player.weights_digest,
            "tasks": tasks,
        });
        output::print(&format!("{answer:#}\n"))?;
    } else {
        let digest = player.weights_digest.map(|digest| format!("weights digest {digest}\n"));
        output::print(&(table(&results) + &digest.unwrap_or_default()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// A result as records have it, with the spread of its episodes.
fn in_json(result: &TaskResult) -> Result<Value, serde_json::Error> {
    let mut value = serde_json::to_value(result)?;
    let ends = half_width(result).map(|half| [result.mean_return - half, result.mean_return + half]);
    value["std_return"] = json!(result.std_return());
    value["ci95_return"] = json!(ends);
    Ok(value)
}

/// Half the width of the mean return's 95 % interval over episodes, of Student's t; none of fewer than two episodes, or where
/// only the mean is known.
fn half_width(result: &TaskResult) -> Option<f64> {
    let returns: Vec<f64> = result.each.as_ref()?.returns.iter().map(|&it| f64::from(it)).collect();
    let interval = rit_statistics::t_interval(&returns)?;
    Some((interval.high - interval.low) / 2.0)
}

/// What a line of the table says.
struct Row {
    name: String,
    episodes: u64,
    mean_return: f64,
    std_return: Option<f64>,
    /// Half the width of the mean's 95 % interval.
    ci95_return: Option<f64>,
    win_rate: Option<f64>,
}

impl Row {
    fn of(result: &TaskResult) -> Self {
        Self {
            name: result.task.clone(),
            episodes: result.episodes,
            mean_return: result.mean_return,
            std_return: result.std_return(),
            ci95_return: half_width(result),
            win_rate: result.win_rate,
        }
    }

    /// The mean over tasks, each counting the same however many episodes it was measured over; tasks are measured apart,
    /// so squares of half widths add up. `None` of fewer than two.
    fn mean(rows: &[Self]) -> Option<Self> {
        if rows.len() < 2 {
            return None;
        }
        let count = rows.len() as f64;
        let wins: Option<f64> = rows.iter().map(|row| row.win_rate).sum();
        let squares: Option<f64> = rows.iter().map(|row| row.ci95_return.map(|half| half * half)).sum();
        Some(Self {
            name: "mean".to_owned(),
            episodes: rows.iter().map(|row| row.episodes).sum(),
            mean_return: rows.iter().map(|row| row.mean_return).sum::<f64>() / count,
            // Of returns of different tasks there is no deviation that says anything.
            std_return: None,
            ci95_return: squares.map(|squares| squares.sqrt() / count),
            win_rate: wins.map(|wins| wins / count),
        })
    }
}

/// One line a task, and their mean: mean return, standard deviation over episodes, 95 % interval of the mean, win rate.
fn table(results: &[TaskResult]) -> String {
    let mut rows: Vec<Row> = results.iter().map(Row::of).collect();
    rows.extend(Row::mean(&rows));
    let width = rows.iter().map(|row| row.name.len()).max().unwrap_or(0).max("task".len());
    let mut text =
        format!("{:width$}  episodes  mean return       std        95 % interval  win rate\n", "task");
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
    for Row { name, episodes, mean_return, std_return, ci95_return, win_rate } in rows {
        let std = or_dash(std_return.map(|std| format!("{std:.2}")));
        let ends = or_dash(
            ci95_return.map(|half| format!("[{:.2}, {:.2}]", mean_return - half, mean_return + half)),
        );
        let wins = or_dash(win_rate.map(|rate| format!("{rate:.3}")));
        // Writing to a String does not fail.
        let _ = writeln!(
            text,
            "{name:width$}  {episodes:8}  {mean_return:11.2}  {std:>8}  {ends:>19}  {wins:>8}"
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_record::EachEpisode;

    fn result(task: &str, returns: &[f32], win_rate: Option<f64>) -> TaskResult {
        let each = EachEpisode { returns: returns.to_vec(), lengths: vec![1; returns.len()], wins: vec![] };
        let mean_return = returns.iter().map(|&it| f64::from(it)).sum::<f64>() / returns.len() as f64;
        let episodes = returns.len() as u64;
        TaskResult { task: task.into(), episodes, mean_return, win_rate, each: Some(each), exploring: None }
    }

    /// 1, 2, 3, 4: mean 2.5, deviation 1.291 (by hand in the record's tests), and t(3) = 3.182 of tables makes the half width
    /// 3.182 · 1.291 / 2 = 2.054. With a task of no spread at 10.0 the mean is 6.25 and the half width 2.054 / 2 = 1.027.
    #[test]
    fn a_line_says_mean_deviation_and_interval() {
        let results =
            [result("a", &[1.0, 2.0, 3.0, 4.0], Some(0.25)), result("long-name", &[10.0; 4], Some(0.75))];
        let expected = "task       episodes  mean return       std        95 % interval  win rate\n\
                        a                 4         2.50      1.29         [0.45, 4.55]     0.250\n\
                        long-name         4        10.00      0.00       [10.00, 10.00]     0.750\n\
                        mean              8         6.25         -         [5.22, 7.28]     0.500\n";
        assert_eq!(table(&results), expected);
        let one = table(&results[..1]);
        assert!(one.lines().count() == 2, "of one task there is nothing to mix: {one}");
        let single = table(&[result("a", &[1.0], None)]);
        assert!(
            single.ends_with("a            1         1.00         -                    -         -\n"),
            "{single}"
        );
    }

    #[test]
    fn a_mean_counts_every_task_the_same() {
        let rows = [result("a", &[1.0; 10], None), result("b", &[4.0; 30], None)].map(|it| Row::of(&it));
        let mean = Row::mean(&rows).unwrap();
        assert_eq!((mean.episodes, mean.mean_return, mean.win_rate), (40, 2.5, None));
    }
}
