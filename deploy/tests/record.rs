//! What a run leaves: each episode of its evaluations, how it was made, and its best policy.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, metrics_lines, output, refused};
use rit_env::Split;
use rit_record::{Ended, Occasion, Record};
use serde_json::Value;
use std::path::Path;

/// Small networks whose win rate goes up and down while they learn.
const BEST: &[&str] = &[
    "matrix-game",
    "--seed",
    "3",
    "--steps",
    "1500",
    "--set",
    "network.hidden_dim=8",
    "--set",
    "evaluation.every_env_steps=100",
    "--set",
    "evaluation.episodes=4",
    "--set",
    "checkpoints.every_env_steps=250",
    "--set",
    "checkpoints.keep_best=mean_return",
    "--set",
    "evaluation.absolute_metric=true",
];

fn mean(evaluation: &rit_record::Evaluation) -> f64 {
    evaluation.tasks.values().map(|result| result.mean_return).sum::<f64>() / evaluation.tasks.len() as f64
}

/// What of a record follows from the seed alone.
fn facts(record: &Record) -> Vec<(u64, Occasion, String)> {
    let fact = |it: &rit_record::Evaluation| (it.progress.env_steps, it.occasion, format!("{:?}", it.tasks));
    record.evaluations.iter().map(fact).collect()
}

fn evaluate(run_dir: &Path, which: &str) -> Value {
    let run = run_dir.to_str().unwrap();
    let output = output(&["evaluate", "--run", run, "--checkpoint", which, "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_best_policy_is_kept_through_everything() {
    let folder = RunFolder::new();
    folder.train(BEST);
    let record = Record::read(&folder.run_dir()).unwrap();
    let best = record.best.clone().unwrap();
    let curve = record.curve(Split::Training);
    let highest = curve.iter().map(|(_, it)| mean(it)).fold(f64::NEG_INFINITY, f64::max);
    let first = curve.iter().find(|(_, it)| mean(it) == highest).unwrap();
    assert_eq!((best.value, best.progress), (highest, first.1.progress), "of equals the first");
    assert_eq!(best.measure, "mean_return");

    // The absolute metric: ten times as many episodes, each of them known.
    let absolute = record.latest(Occasion::Best, Split::Training).unwrap();
    assert!(best.evaluation.values().all(|result| result.episodes == 40));
    assert!(absolute.tasks.values().all(|result| result.each.as_ref().unwrap().returns.len() == 40));

    // It plays, and is not the newest unless that is the best.
    let played = evaluate(&folder.run_dir(), "best");
    assert_eq!(played["weights_digest"], Value::from(best.weights_digest.clone()));
    assert_eq!(
        evaluate(&folder.run_dir(), "latest")["weights_digest"].as_str(),
        record.weights_digest.as_deref()
    );
    evaluate(&folder.run_dir(), "step-1500");
    let run = folder.run_dir();
    let run = run.to_str().unwrap();
    refused(
        &["evaluate", "--run", run, "--checkpoint", "step-7"],
        &["holds no checkpoint at 7 steps; there are: step-"],
    );
    refused(&["evaluate", "--run", run, "--checkpoint", "first"], &["write latest, best or step-N"]);

    // A run that was stopped and whose processes were killed comes to the same.
    let disturbed = RunFolder::new();
    let mut train = disturbed.start(BEST);
    train.wait_for("some steps", |status| status["env_steps"].as_u64() > Some(600));
    train.ctl(&["stop"]);
    let code = train.wait().status.code();
    assert!([Some(3), Some(0)].contains(&code), "stopped, or just finished: {code:?}");
    Train::resume(&disturbed, &[]).finish();
    let again = Record::read(&disturbed.run_dir()).unwrap();
    assert_eq!(facts(&again), facts(&record));
    assert_eq!((again.best.unwrap().weights_digest, again.broken_lines), (best.weights_digest, 0));
}

#[test]
fn a_run_says_how_it_was_made_and_what_it_took() {
    let folder = RunFolder::new();
    let summary = folder.train(&["matrix-game", "--steps", "400", "--seed", "7", "--algorithm", "vdn-attn"]);
    let record = Record::read(&folder.run_dir()).unwrap();
    assert_eq!(
        (record.seed, record.method(), record.ended),
        (Some(7), Some("vdn-attn"), Some(Ended::Finished))
    );
    assert_eq!(record.build.as_ref().unwrap().version, env!("CARGO_PKG_VERSION"));
    let host = record.host.as_ref().unwrap();
    assert!(host.cores > 0 && !host.name.is_empty(), "{host:?}");
    assert!(record.parameters.unwrap() > 1000 && record.measures.iter().any(|it| it.name == "td_loss"));
    // Learner and actors: more than a process takes to start, and no more than all processors had time for.
    let cpu_s = record.cpu_s.unwrap();
    assert!(cpu_s > 0.01 && cpu_s < 60.0 * host.cores as f64, "{cpu_s}");
    assert_eq!(summary["cpu_s"].as_f64(), Some(cpu_s));
    refused(
        &["evaluate", "--run", folder.run_dir().to_str().unwrap(), "--checkpoint", "best"],
        &["keeps no best policy: checkpoints.keep_best was not set"],
    );
}

#[test]
fn testing_tasks_have_a_schedule_of_their_own_and_decide_nothing() {
    let train = |every: &str| {
        let folder = RunFolder::new();
        let every = format!("evaluation.testing_every_env_steps={every}");
        let sets = [
            "network.hidden_dim=8",
            "algorithm.batch_size=2",
            "evaluation.every_env_steps=1000",
            "evaluation.episodes=2",
            "evaluation.testing_episodes=3",
            &every,
        ];
        let sets = sets.iter().flat_map(|setting| ["--set", setting]);
        let arguments = ["cooperative-navigation", "--steps", "2000"].into_iter().chain(sets);
        let summary = folder.train(&arguments.collect::<Vec<_>>());
        (folder, summary)
    };
    let (with, summary) = train("500");
    let (without, other) = train("0");
    assert_eq!(summary["weights_digest"], other["weights_digest"]);
    assert!(other.get("testing").is_none());
    let record = Record::read(&with.run_dir()).unwrap();
    let curve = record.curve(Split::Testing);
    assert_eq!(curve.iter().map(|(at, _)| *at).collect::<Vec<_>>(), [0, 500, 1000, 1500, 2000]);
    assert_eq!(record.tasks(Split::Testing), ["navigation-5-5", "navigation-6-6"]);
    for (_, evaluation) in curve {
        let each = evaluation.tasks["navigation-5-5"].each.as_ref().unwrap();
        assert_eq!((each.returns.len(), &each.lengths, each.wins.len()), (3, &vec![25; 3], 0));
    }
    let last = record.latest(Occasion::Final, Split::Testing).unwrap();
    assert_eq!(summary["testing"]["navigation-6-6"]["mean_return"], last.tasks["navigation-6-6"].mean_return);
    let of_testing =
        metrics_lines(&without.run_dir()).iter().filter(|line| line["split"] == "testing").count();
    assert_eq!(of_testing, 0);
}
