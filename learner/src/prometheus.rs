//! A run's status as Prometheus reads it: the OpenMetrics text format.
//!
//! Nothing is counted here: each scrape shows what the status says. Progress goes on through a restart of the
//! learner; other counters begin with its process, as Prometheus expects.

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, MetricEncoder, NoLabelSet, text},
    metrics::MetricType::{self, Counter, Gauge},
    registry::{Registry, Unit},
};
use rit_proto::v1::{ActorStatus, RunState, RunStatus, TaskResult};
use std::{collections::HashMap, fmt};

/// What the text is served as.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The text for a status.
///
/// # Errors
/// None in practice: it is written into memory.
pub fn render(status: RunStatus) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("rit");
    registry.register_collector(Box::new(Scrape(status)));
    let mut out = String::new();
    text::encode(&mut out, &registry)?;
    Ok(out)
}

/// All samples of one name.
struct Family<'a> {
    kind: MetricType,
    /// Without the prefix `rit_`, the unit and a counter's `_total`.
    name: &'static str,
    help: &'static str,
    unit: Option<Unit>,
    samples: Vec<Sample<'a>>,
}

/// A label, where there is one, and a number.
type Sample<'a> = (Option<(&'static str, &'a str)>, f64);

#[derive(Debug)]
struct Scrape(RunStatus);

impl Collector for Scrape {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let status = &self.0;
        for families in [run(status), training(status), tasks(status), actors(status), accounts(status)] {
            for Family { kind, name, help, unit, samples } in families {
                let mut out = encoder.encode_descriptor(name, help, unit.as_ref(), kind)?;
                for (label, value) in samples {
                    match label {
                        Some((key, text)) => {
                            write(&mut out.encode_family(&[(key, escaped(text))])?, kind, value)?;
                        }
                        None => write(&mut out, kind, value)?,
                    }
                }
            }
        }
        Ok(())
    }
}

fn write(out: &mut MetricEncoder<'_>, kind: MetricType, value: f64) -> fmt::Result {
    match kind {
        Counter => out.encode_counter::<NoLabelSet, f64, f64>(&value, None),
        _ => out.encode_gauge(&value),
    }
}

/// Names may hold any characters, and the encoder writes label values as they are.
fn escaped(text: &str) -> String {
    text.replace('\\', r"\\").replace('"', r#"\""#).replace('\n', r"\n")
}

fn run(status: &RunStatus) -> Vec<Family<'_>> {
    let state = |name, state| (Some(("state", name)), f64::from(u8::from(status.state() == state)));
    let states = vec![
        state("running", RunState::Running),
        state("paused", RunState::Paused),
        state("stopping", RunState::Stopping),
    ];
    let rates = status.rates.unwrap_or_default();
    vec![
        Family {
            kind: Gauge,
            name: "state",
            help: "1 for the state the run is in",
            unit: None,
            samples: states,
        },
        one(Counter, "env_steps", "Environment steps collected", status.env_steps as f64),
        one(Gauge, "env_steps_max", "Environment steps to collect", status.env_steps_max as f64),
        one(Counter, "episodes", "Episodes collected", status.episodes as f64),
        one(Counter, "updates", "Updates made", status.updates as f64),
        one(Gauge, "env_steps_per_second", "Rate over the last seconds", rates.env_steps_per_s),
        one(Gauge, "episodes_per_second", "Rate over the last seconds", rates.episodes_per_s),
        one(Gauge, "updates_per_second", "Rate over the last seconds", rates.updates_per_s),
        one(Gauge, "uptime", "Since the learner began", status.wall_s).in_unit(Unit::Seconds),
    ]
}

fn training(status: &RunStatus) -> Vec<Family<'_>> {
    let waiting = "Training waited for episodes while the run was not paused";
    let measures = status.measures.iter().map(|it| (Some(("measure", it.name.as_str())), it.value));
    let (held, held_max) = (status.replay_episodes as f64, status.replay_episodes_max as f64);
    vec![
        one(Gauge, "epsilon", "Probability of a random action", status.epsilon),
        Family {
            kind: Gauge,
            name: "measure",
            help: "What the last update reported, by name",
            unit: None,
            samples: measures.collect(),
        },
        one(Gauge, "replay_episodes", "Episodes in replay", held),
        one(Gauge, "replay_episodes_max", "Episodes that replay can hold", held_max),
        one(Counter, "learner_waiting", waiting, status.learner_waiting_s).in_unit(Unit::Seconds),
        one(Counter, "shared_memory", "Frames read from shared memory", status.shared_memory_bytes as f64)
            .in_unit(Unit::Bytes),
    ]
}

fn tasks(status: &RunStatus) -> Vec<Family<'_>> {
    let recent = |kind, name, help, value: fn(&TaskResult) -> Option<f64>| {
        by_task(kind, name, help, &status.recent, value)
    };
    let mut families = vec![
        recent(Counter, "task_episodes", "Episodes collected", |r| r.episodes_total.map(|n| n as f64)),
        recent(Gauge, "exploring_return", "Mean return of exploring episodes of late", |r| {
            Some(r.mean_return)
        }),
        recent(Gauge, "exploring_win_rate", "Share of exploring episodes of late that won", |r| r.win_rate),
        recent(Gauge, "policy_lag_updates", "Updates made since the newest episode's weights", |r| {
            r.policy_lag.map(|lag| lag as f64)
        }),
    ];
    if let Some(evaluation) = &status.evaluation {
        let greedy = |name, help, value| by_task(Gauge, name, help, &evaluation.tasks, value);
        let at = evaluation.env_steps as f64;
        families.extend([
            one(Gauge, "evaluation_env_steps", "Environment steps at the newest evaluation", at),
            greedy("evaluation_return", "Mean return in the newest evaluation", |r| Some(r.mean_return)),
            greedy("evaluation_win_rate", "Share of episodes won in the newest evaluation", |r| r.win_rate),
        ]);
    }
    families
}

fn actors(status: &RunStatus) -> Vec<Family<'_>> {
    let each = |kind, name, help, value: fn(&ActorStatus) -> f64| {
        let samples = status.actors.iter().map(|actor| (Some(("actor", actor.name.as_str())), value(actor)));
        Family { kind, name, help, unit: None, samples: samples.collect() }
    };
    let waiting = "The ledger handed nothing out to the actor while the run was not paused";
    vec![
        one(Gauge, "actors", "Actors that have joined", status.actors.len() as f64),
        each(Counter, "actor_episodes", "Episodes taken from the actor", |actor| actor.episodes as f64),
        each(Gauge, "actor_outstanding_episodes", "Episodes the actor has", |actor| actor.outstanding as f64),
        each(Gauge, "actor_hung", "1 for an actor silent for too long", |actor| {
            f64::from(u8::from(actor.hung))
        }),
        each(Gauge, "actor_silent", "Since the actor's last sign of life", |actor| actor.silent_s)
            .in_unit(Unit::Seconds),
        each(Counter, "actor_waiting", waiting, |actor| actor.waiting_s).in_unit(Unit::Seconds),
    ]
}

fn accounts(status: &RunStatus) -> Vec<Family<'_>> {
    let mut families = Vec::new();
    if let Some(ledger) = &status.ledger {
        let outstanding = ledger.outstanding as f64;
        let rejected = "Episodes taken back from actors";
        families.extend([
            one(Counter, "ledger_handed_out_episodes", "Episodes handed to actors", ledger.handed_out as f64),
            one(Counter, "ledger_inserted_episodes", "Episodes taken from actors", ledger.inserted as f64),
            one(Gauge, "ledger_outstanding_episodes", "Episodes that actors have", outstanding),
            by_reason("ledger_rejected_episodes", rejected, &ledger.rejected),
            by_reason("frames_refused", "Frames that were not let in", &ledger.frames_refused),
            one(Counter, "ledger_imbalances", "Times the ledger did not balance", ledger.imbalances as f64),
        ]);
    }
    if let Some(checkpoints) = &status.checkpoints {
        families.extend([
            one(Counter, "checkpoints_written", "Checkpoints written", checkpoints.written as f64),
            one(Counter, "checkpoints_failed", "Checkpoints not written", checkpoints.failed as f64),
            one(Counter, "checkpoint_writing", "Spent on checkpoints", checkpoints.total_s)
                .in_unit(Unit::Seconds),
            one(Gauge, "checkpoint_last", "Spent on the newest checkpoint", checkpoints.last_s)
                .in_unit(Unit::Seconds),
            one(Gauge, "checkpoint_env_steps", "Of the newest checkpoint", checkpoints.env_steps as f64),
        ]);
    }
    families
}

impl Family<'_> {
    fn in_unit(self, unit: Unit) -> Self {
        Self { unit: Some(unit), ..self }
    }
}

fn one(kind: MetricType, name: &'static str, help: &'static str, value: f64) -> Family<'static> {
    Family { kind, name, help, unit: None, samples: vec![(None, value)] }
}

fn by_task<'a>(
    kind: MetricType,
    name: &'static str,
    help: &'static str,
    results: &'a [TaskResult],
    value: fn(&TaskResult) -> Option<f64>,
) -> Family<'a> {
    let samples = results.iter().filter_map(|result| Some((Some(("task", &*result.task)), value(result)?)));
    Family { kind, name, help, unit: None, samples: samples.collect() }
}

fn by_reason<'a>(name: &'static str, help: &'static str, counts: &'a HashMap<String, u64>) -> Family<'a> {
    let mut samples: Vec<Sample<'_>> =
        counts.iter().map(|(reason, &count)| (Some(("reason", reason.as_str())), count as f64)).collect();
    samples.sort_by_key(|(label, _)| *label);
    Family { kind: Counter, name, help, unit: None, samples }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_proto::v1::{CheckpointsStatus, Evaluation, LedgerStatus, Measure, Rates};
    use std::{collections::HashSet, fs, path::Path};

    fn status() -> RunStatus {
        let result = |task: &str, win_rate, lag| TaskResult {
            task: task.into(),
            mean_return: -1.5,
            win_rate,
            episodes_total: Some(10),
            policy_lag: lag,
            ..TaskResult::default()
        };
        let measure = |(name, value): (&str, f64)| Measure { name: name.into(), value, ..Measure::default() };
        RunStatus {
            state: RunState::Paused.into(),
            env_steps: 5_050_000,
            rates: Some(Rates { updates_per_s: 12.5, ..Rates::default() }),
            recent: vec![result("3v3", Some(0.25), Some(1)), result("4v4", None, Some(2))],
            evaluation: Some(Evaluation {
                tasks: vec![result("3v3", Some(0.5), None)],
                ..Evaluation::default()
            }),
            actors: vec![ActorStatus {
                name: "a \"b\" \\ c".into(),
                hung: true,
                waiting_s: 0.5,
                ..Default::default()
            }],
            ledger: Some(LedgerStatus {
                rejected: HashMap::from([("actor_gone".into(), 3), ("actor_hung".into(), 4)]),
                frames_refused: HashMap::from([("checksum".into(), 2)]),
                ..LedgerStatus::default()
            }),
            learner_waiting_s: 1.25,
            measures: [("td_loss", 0.5), ("role_kl", 0.25)].map(measure).to_vec(),
            shared_memory_bytes: 1 << 40,
            checkpoints: Some(CheckpointsStatus { written: 2, total_s: 0.75, ..Default::default() }),
            ..RunStatus::default()
        }
    }

    /// Samples by name with labels, and names by type, each read as the format says.
    fn parse(text: &str) -> (HashMap<String, f64>, HashMap<String, String>) {
        let (mut samples, mut types) = (HashMap::new(), HashMap::new());
        let mut lines = text.lines().peekable();
        while let Some(line) = lines.next() {
            let words: Vec<&str> = line.splitn(4, ' ').collect();
            match words[..] {
                ["#", "EOF"] => assert_eq!(lines.peek(), None, "nothing after the end"),
                ["#", "HELP", _, help] => assert!(!help.is_empty()),
                ["#", "TYPE", name, kind] => {
                    assert!(types.insert(name.to_owned(), kind.to_owned()).is_none(), "{name} once");
                }
                ["#", "UNIT", name, unit] => assert!(name.ends_with(unit), "{line}"),
                _ => {
                    let (key, value) = line.rsplit_once(' ').unwrap();
                    let name = key.split('{').next().unwrap();
                    let family = name.strip_suffix("_total").unwrap_or(name);
                    let kind = if name.ends_with("_total") { "counter" } else { "gauge" };
                    assert_eq!(types.get(family).map(String::as_str), Some(kind), "{line}");
                    assert!(samples.insert(key.to_owned(), value.parse().unwrap()).is_none(), "{key} once");
                }
            }
        }
        assert!(text.ends_with("# EOF\n"));
        (samples, types)
    }

    #[test]
    fn the_text_says_what_the_status_says() {
        let (samples, types) = parse(&render(status()).unwrap());
        for (key, value) in [
            (r#"rit_state{state="paused"}"#, 1.0),
            (r#"rit_state{state="running"}"#, 0.0),
            ("rit_env_steps_total", 5_050_000.0),
            ("rit_updates_per_second", 12.5),
            (r#"rit_measure{measure="td_loss"}"#, 0.5),
            (r#"rit_measure{measure="role_kl"}"#, 0.25),
            (r#"rit_exploring_return{task="4v4"}"#, -1.5),
            (r#"rit_exploring_win_rate{task="3v3"}"#, 0.25),
            (r#"rit_evaluation_win_rate{task="3v3"}"#, 0.5),
            (r#"rit_policy_lag_updates{task="4v4"}"#, 2.0),
            (r#"rit_task_episodes_total{task="3v3"}"#, 10.0),
            (r#"rit_actor_hung{actor="a \"b\" \\ c"}"#, 1.0),
            (r#"rit_actor_waiting_seconds_total{actor="a \"b\" \\ c"}"#, 0.5),
            (r#"rit_ledger_rejected_episodes_total{reason="actor_hung"}"#, 4.0),
            (r#"rit_frames_refused_total{reason="checksum"}"#, 2.0),
            ("rit_ledger_imbalances_total", 0.0),
            ("rit_learner_waiting_seconds_total", 1.25),
            ("rit_shared_memory_bytes_total", 1_099_511_627_776.0),
            ("rit_checkpoint_writing_seconds_total", 0.75),
        ] {
            assert_eq!(samples.get(key), Some(&value), "{key} in {samples:#?}");
        }
        assert_eq!(
            samples.get(r#"rit_exploring_win_rate{task="4v4"}"#),
            None,
            "a task that knows no winning"
        );
        assert!(types.keys().all(|name| name.starts_with("rit_")));
    }

    #[test]
    fn dashboards_and_alerts_ask_for_what_there_is() {
        let (samples, _) = parse(&render(status()).unwrap());
        let names: HashSet<&str> = samples.keys().filter_map(|key| key.split('{').next()).collect();
        let deploy = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
        for file in ["grafana/rit.json", "prometheus/rit.rules.yml", "prometheus/rit.rules.test.yml"] {
            let text = fs::read_to_string(deploy.join(file)).unwrap();
            let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
            let asked: HashSet<&str> = words.filter(|word| word.starts_with("rit_")).collect();
            assert!(!asked.is_empty(), "{file} asks for something");
            let unknown: Vec<_> = asked.difference(&names).collect();
            assert!(unknown.is_empty(), "{file} asks for {unknown:?}");
        }
    }

    #[test]
    fn a_status_of_nothing_is_a_text_too() {
        let (samples, _) = parse(&render(RunStatus::default()).unwrap());
        assert_eq!(samples["rit_env_steps_total"], 0.0);
    }
}
