//! Whole records: run directories, committed ones, and those of the builds before.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests too")]

use rit_config::{Config, OwnedRunDir, resolve, set};
use rit_env::Split;
use rit_record::{
    Build, Cell, CellState, EachEpisode, Ended, Evaluation, Header, Line, Occasion, Progress, Record, Run,
    Shapley, Summary, Sweep, TaskResult, TrainingPoint, commit, discover,
};
use std::{
    fs,
    path::{Path, PathBuf},
};

fn config(settings: &[&str]) -> Config {
    let settings: Vec<_> = settings.iter().map(|text| set(text).unwrap()).collect();
    resolve("environment.task_set = \"cooperative-navigation\"", "test", &settings).unwrap()
}

fn evaluation(env_steps: u64, occasion: Occasion, split: Split, returns: &[f32]) -> Evaluation {
    let each = EachEpisode { returns: returns.to_vec(), lengths: vec![25; returns.len()], wins: Vec::new() };
    let result = TaskResult {
        task: "navigation-2-2".into(),
        episodes: returns.len() as u64,
        mean_return: returns.iter().map(|&it| f64::from(it)).sum::<f64>() / returns.len() as f64,
        each: Some(each),
        ..TaskResult::default()
    };
    let progress = Progress { env_steps, episodes: env_steps / 25, updates: env_steps / 200 };
    Evaluation::new(progress, env_steps as f64, occasion, split, &[result])
}

fn training(env_steps: u64) -> Line {
    let Evaluation { progress, wall_s, .. } =
        evaluation(env_steps, Occasion::Scheduled, Split::Training, &[0.0]);
    let measured = [("td_loss".to_owned(), f64::NAN)].into_iter().collect();
    Line::Training(TrainingPoint { progress, wall_s, epsilon: 0.5, tasks: [].into(), measured })
}

/// A run as a learner leaves it, whose evaluations come every 100 steps and a few steps late.
fn run(root: &Path, settings: &[&str]) {
    let all = [&["evaluation.every_env_steps=100"][..], settings].concat();
    let config = config(&all);
    let run_dir = OwnedRunDir::create(root, &config).unwrap().run_dir().clone();
    let made = Run::begins(&config, Build::this(Some("c0ffee")), 7, &[]).unwrap();
    let mut text = Header::new(&run_dir, made).line().unwrap();
    for line in [
        Line::Evaluation(evaluation(0, Occasion::Scheduled, Split::Training, &[-9.0, -7.0])),
        training(50),
        Line::Evaluation(evaluation(103, Occasion::Scheduled, Split::Training, &[-4.0, -2.0])),
        Line::Evaluation(evaluation(103, Occasion::Scheduled, Split::Testing, &[-8.0])),
        Line::Evaluation(evaluation(130, Occasion::Final, Split::Training, &[-3.0, -2.0])),
    ] {
        serde_json::to_writer(&mut text, &line).unwrap();
        text.push(b'\n');
    }
    text.extend(b"{\"kind\":\"evalu");
    fs::write(run_dir.metrics(), text).unwrap();
}

fn end(root: &Path, ended: Ended) {
    let (run_dir, _) = rit_config::RunDir::open(root).unwrap();
    let progress = Progress { env_steps: 130, episodes: 5, updates: 1 };
    let summary = Summary { ended, progress, wall_s: 3.0, cpu_s: Some(5.5), ..Summary::default() };
    summary.write(&run_dir).unwrap();
}

#[test]
fn a_run_directory_says_all_of_its_run() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("run");
    run(&root, &["seed=4", "algorithm.name=vdn-attn"]);
    let record = Record::read(&root).unwrap();
    assert_eq!((record.ended, record.is_whole(), record.cpu_s), (None, false, None), "it runs yet");
    assert_eq!(
        (record.seed, record.method(), record.task_set()),
        (Some(4), Some("vdn-attn"), Some("cooperative-navigation"))
    );
    assert_eq!((record.env_steps_max(), record.parameters), (Some(5_050_000), Some(7)));
    assert_eq!(record.build.as_ref().unwrap().commit.as_deref(), Some("c0ffee"));
    assert_eq!((record.broken_lines, record.training.len(), record.evaluations.len()), (0, 1, 4));
    assert!(record.training[0].measured.values[0].1.is_nan());
    let curve: Vec<_> = record
        .curve(Split::Training)
        .iter()
        .map(|(at, it)| (*at, it.tasks["navigation-2-2"].mean_return))
        .collect();
    assert_eq!(curve, [(0, -8.0), (100, -3.0)], "where they were due");
    let last = record.latest(Occasion::Final, Split::Training).unwrap();
    assert_eq!(last.tasks["navigation-2-2"].each.as_ref().unwrap().returns, [-3.0, -2.0]);
    assert!(record.latest(Occasion::Best, Split::Training).is_none());
    end(&root, Ended::Interrupted);
    let record = Record::read(&root.join("metrics.jsonl")).unwrap();
    assert_eq!((record.ended, record.is_whole(), record.cpu_s), (Some(Ended::Interrupted), false, Some(5.5)));
}

#[test]
fn the_seed_and_what_no_result_follows_from_make_no_other_kind() {
    let folder = tempfile::tempdir().unwrap();
    let kind = |name: &str, settings: &[&str]| {
        let root = folder.path().join(name);
        run(&root, settings);
        Record::read(&root).unwrap().kind
    };
    let one = kind("one", &["seed=1"]);
    assert_eq!(kind("two", &["seed=2", "actors.count=7", "training.t_max=9"]), one);
    assert_ne!(kind("three", &["algorithm.gamma=0.5"]), one);
    assert_eq!(one["evaluation.every_env_steps"], "100");
}

#[test]
fn a_record_from_before_a_setting_existed_had_its_default() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("run");
    run(&root, &["seed=4"]);
    end(&root, Ended::Finished);
    let [jsonl, _] = commit(&root, &folder.path().join("run_seed-4")).unwrap();
    let today = Record::read(&jsonl).unwrap();
    let text = fs::read_to_string(&jsonl).unwrap();
    let before = text.replacen("\"algorithm.reward_scale\":\"1.0\",", "", 1);
    assert_ne!(before, text);
    fs::write(&jsonl, before).unwrap();
    let older = Record::read(&jsonl).unwrap();
    assert!(!older.settings.contains_key("algorithm.reward_scale"), "what was written stays");
    assert_eq!(older.kind, today.kind);
}

#[test]
fn a_committed_record_says_what_the_run_directory_said() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("run");
    run(&root, &["seed=4"]);
    let stem = folder.path().join("gamma-0.8-seed-4");
    assert!(commit(&root, &stem).unwrap_err().to_string().contains("summary.json"), "it has not ended");
    end(&root, Ended::Finished);
    let [jsonl, json] = commit(&root, &stem).unwrap();
    let mut expected = Record::read(&root).unwrap();
    let scheduled = expected.evaluations.iter_mut().filter(|it| it.occasion == Occasion::Scheduled);
    scheduled.flat_map(|it| it.tasks.values_mut()).for_each(|task| task.each = None);
    assert!(expected.evaluations.iter().any(|it| it.tasks.values().any(|task| task.each.is_some())));
    for given in [&jsonl, &json] {
        let found = Record::read(given).unwrap();
        let same = Record {
            path: expected.path.clone(),
            name: expected.name.clone(),
            folder: expected.folder.clone(),
            training: expected.training.clone(),
            ..found.clone()
        };
        // NaN, which a line of training has here, is like nothing.
        assert_eq!(format!("{same:?}"), format!("{expected:?}"));
        assert!(found.training.is_empty() && found.is_whole());
    }
    let again = commit(&root, &stem).unwrap_err().to_string();
    assert!(again.contains("gamma-0.8-seed-4.json: entity already exists"), "{again}");
}

/// Where the repository keeps its results.
#[test]
fn what_shapley_values_said_is_kept_with_the_run_and_with_its_committed_record() {
    let folder = tempfile::tempdir().unwrap();
    let (root, stem) = (folder.path().join("run"), folder.path().join("rit_gamma-0.8_seed-3"));
    run(&root, &[]);
    end(&root, Ended::Finished);
    let points: Vec<[f64; 2]> = (0..1000).map(|at| [f64::from(at), 0.123_456]).collect();
    let found = Shapley { task: "navigation-2-2".into(), agents: 2, points, ..Shapley::default() };
    let earlier = Shapley { agents: 9, ..found.clone() };
    earlier.keep(&root).unwrap();
    assert!(found.keep(&root).unwrap().ends_with("shapley/navigation-2-2.json"));
    Shapley { task: "a/b".into(), mean_shapley: f64::NAN, ..Shapley::default() }.keep(&root).unwrap();
    let of_run = Record::read(&root).unwrap().shapley;
    assert_eq!(
        of_run.iter().map(|it| (it.task.as_str(), it.agents)).collect::<Vec<_>>(),
        [("a/b", 0), ("navigation-2-2", 2)]
    );
    assert!(of_run[0].mean_shapley.is_nan());
    assert_eq!((of_run[1].points.len(), of_run[1].points[1]), (500, [2.0, 0.1235]));
    commit(&root, &stem).unwrap();
    let committed = Record::read(&folder.path().join("rit_gamma-0.8_seed-3.jsonl")).unwrap();
    assert_eq!((committed.shapley.len(), &committed.shapley[1]), (2, &of_run[1]));
    fs::write(root.join("shapley/a-b.json"), "{}").unwrap();
    let error = Record::read(&root).unwrap_err().to_string();
    assert!(error.contains("a-b.json is no comparison with Shapley values: missing field"), "{error}");
}

fn results() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/results")
}

#[test]
fn records_of_older_builds_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let there = folder.path().join("predator-prey");
    fs::create_dir(&there).unwrap();
    for name in ["seed-2.jsonl", "seed-2.json"] {
        fs::copy(results().join("predator-prey").join(name), there.join(name)).unwrap();
    }
    let record = Record::read(&there.join("seed-2.jsonl")).unwrap();
    assert_eq!((record.seed, record.folder.as_str(), record.method()), (Some(2), "predator-prey", None));
    assert_eq!((record.is_whole(), record.progress.env_steps), (true, 5_050_000));
    assert_eq!(record.kind["evaluation.every_env_steps"], "50000");
    assert_eq!(record.kind["tasks"], "predator-prey-2-1, predator-prey-3-1, predator-prey-3-2");
    assert_eq!(record.curve(Split::Training).len(), 102);
    assert_eq!(record.tasks(Split::Testing), ["predator-prey-4-2", "predator-prey-5-2"]);
    let testing = record.latest(Occasion::Final, Split::Testing).unwrap();
    assert_eq!(testing.tasks["predator-prey-4-2"].episodes, 1000, "the one of most episodes");
    let last = record.latest(Occasion::Final, Split::Training).unwrap();
    assert!(last.tasks.values().all(|result| result.episodes == 32 && result.each.is_none()));

    // A file beside it says what it was trained with: it is of a kind with records that say so themselves.
    fs::write(
        there.join("settings.json"),
        r#"{"algorithm.name":"rit","environment.task_set":"predator-prey"}"#,
    )
    .unwrap();
    let told = Record::read(&there.join("seed-2.jsonl")).unwrap();
    assert_eq!((told.seed, told.method(), told.task_set()), (Some(2), Some("rit"), Some("predator-prey")));
    assert!(!told.kind.contains_key("tasks") && told.evaluations == record.evaluations, "{:?}", told.kind);
    fs::write(there.join("settings.json"), r#"{"algorithm.gamma":0.8}"#).unwrap();
    let error = Record::read(&there.join("seed-2.jsonl")).unwrap_err().to_string();
    assert!(error.contains("settings.json is no list of settings: invalid type"), "{error}");
}

/// Old records and new ones in one folder are averaged where their settings are equal: each key that results follow from.
#[test]
fn settings_beside_older_records_are_those_of_a_new_one() {
    for (folder, changes) in [
        ("cooperative-navigation", &[][..]),
        ("cooperative-navigation-gamma-0.8", &["algorithm.gamma=0.8"]),
        ("predator-prey", &["algorithm.gamma=0.8", "environment.approach_shaping=5.0"]),
        ("predator-prey-pro", &["algorithm.gamma=0.9"]),
        ("predator-prey-pro-shaping", &["algorithm.gamma=0.8", "environment.approach_shaping=5.0"]),
    ] {
        let older = Record::read(&results().join(folder).join("seed-1.jsonl")).unwrap();
        let task_set = folder.trim_end_matches("-gamma-0.8").trim_end_matches("-shaping");
        let scratch = tempfile::tempdir().unwrap();
        let settings = changes.iter().chain(&["evaluation.every_env_steps=50000"]);
        let settings: Vec<_> = settings.map(|it| set(it).unwrap()).collect();
        let text = format!("environment.task_set = \"{task_set}\"");
        let config = resolve(&text, "test", &settings).unwrap();
        let root = scratch.path().join("run");
        OwnedRunDir::create(&root, &config).unwrap();
        assert_eq!(older.kind, Record::read(&root).unwrap().kind, "{folder}");
    }
}

#[test]
fn every_committed_record_is_found_and_read() {
    let found = discover(&[results()]).unwrap();
    assert!(found.len() >= 21, "{found:?}");
    for path in &found {
        let record = Record::read(path).unwrap();
        assert!(record.is_whole() && record.broken_lines == 0, "{record}");
        assert!(!record.evaluations.is_empty() && record.seed.is_some(), "{record}");
    }
    let twice = [results(), results().join("predator-prey"), found[0].clone()];
    assert_eq!(discover(&twice).unwrap(), found, "each once");
}

#[test]
fn what_holds_no_run_is_said_plainly() {
    let folder = tempfile::tempdir().unwrap();
    let none = |path: &Path| discover(&[path.to_owned()]).unwrap_err().to_string();
    assert!(none(folder.path()).contains("holds no record of a run: give a run directory"));
    assert!(none(&folder.path().join("nowhere")).contains("No such file"));
    fs::write(folder.path().join("other.jsonl"), "{\"a\":1}\n").unwrap();
    assert!(none(folder.path()).contains("holds no record of a run"));
    let read = |path: &Path| Record::read(path).unwrap_err().to_string();
    assert!(read(folder.path()).contains("holds no run: it has no config.toml"));
    assert!(read(&folder.path().join("nowhere.json")).contains("holds no record"));
    fs::write(folder.path().join("a.jsonl"), "").unwrap();
    fs::write(folder.path().join("a.json"), "[]").unwrap();
    let other = read(&folder.path().join("a.jsonl"));
    assert!(other.contains("a.json is no summary of a run: "), "{other}");
}

#[test]
fn a_sweep_knows_its_cells_and_how_they_stand() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    assert_eq!(Sweep::read(dir).unwrap(), None);
    let cell = |seed: u64| Cell {
        name: format!("rit-seed-{seed}"),
        experiment: "matrix-game".into(),
        seed,
        settings: [("algorithm.name".to_owned(), "\"rit\"".to_owned())].into(),
    };
    let cells = vec![cell(1), cell(2), cell(3)];
    let sweep = Sweep::new(vec!["algorithm.name".into()], cells);
    sweep.write(dir).unwrap();
    assert_eq!(Sweep::read(dir).unwrap().as_ref(), Some(&sweep));
    run(&Sweep::run_dir(dir, &sweep.cells[1]), &["seed=2"]);
    run(&Sweep::run_dir(dir, &sweep.cells[2]), &["seed=3"]);
    end(&Sweep::run_dir(dir, &sweep.cells[2]), Ended::Until);
    let states: Vec<_> = sweep.cells.iter().map(|cell| Sweep::state(dir, cell)).collect();
    assert_eq!(states, [CellState::Waiting, CellState::Begun, CellState::Ended(Ended::Until)]);
    assert_eq!(discover(&[dir.to_owned()]).unwrap().len(), 2);
    let manifest = dir.join("sweep.json");
    let text = fs::read_to_string(&manifest).unwrap();
    fs::write(&manifest, text.replace("rit-seed-3", "../elsewhere")).unwrap();
    assert!(
        Sweep::read(dir).unwrap_err().to_string().contains("\"../elsewhere\", which is no folder's name")
    );
    fs::write(&manifest, text.replace("\"format_version\": 1", "\"format_version\": 2")).unwrap();
    assert!(Sweep::read(dir).unwrap_err().to_string().contains("has format version 2, this build reads 1"));
}
