use super::*;
use crate::{
    coordinator::{Event, Input},
    ledger::Terms,
    replay_log::ReplayLog,
    tensorboard::Position,
    write_queue::write_queue,
    writer::Writer,
};
use rit_config::{Config, OwnedRunDir};
use rit_episode::{
    RunSeed, Stream,
    wire::{Expected, PayloadLayout, TaskSize},
};
use rit_record::{Best, Exploring, Progress};
use std::{
    collections::BTreeSet,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

struct Run {
    _folder: tempfile::TempDir,
    run_dir: RunDir,
    model: Model,
    learner: Box<dyn Learner>,
    config: Config,
}

fn run() -> Run {
    let mut config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
    config.algorithm.buffer_size = 0;
    let folder = tempfile::tempdir().unwrap();
    let run_dir = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap().run_dir().clone();
    let model = Model::new(config.model()).unwrap();
    let params = model.initial(&mut RunSeed(1).stream(Stream::Weights, 0));
    let learner = model.learner(config.update(), params).unwrap();
    Run { _folder: folder, run_dir, model, learner, config }
}

impl Run {
    /// A state whose numbers tell which it is. Its run has a replay of no episodes.
    fn state(&self, env_steps: u64) -> TrainingState {
        let numbers = |len: usize, index: u64| -> Vec<f32> {
            let layout = self.model.initial(&mut RunSeed(env_steps).stream(Stream::Weights, index));
            layout.into_iter().cycle().take(len).collect()
        };
        let params = numbers(self.learner.params().len(), 0);
        let acting = numbers(self.learner.acting().len(), 1);
        let learner =
            self.learner.state().into_iter().enumerate().map(|(index, NamedState { name, numbers: its })| {
                let numbers = match its {
                    Numbers::F32(its) => Numbers::F32(numbers(its.len(), 2 + index as u64).into()),
                    Numbers::F64(its) => Numbers::F64(vec![0.1 + 0.2; its.len()].into()),
                    Numbers::U64(its) => Numbers::U64(vec![env_steps; its.len()].into()),
                };
                NamedState { name, numbers }
            });
        let best = Best {
            measure: "mean_return".into(),
            value: 0.1 + 0.2,
            progress: Progress { env_steps: 2, episodes: 2, updates: 1 },
            weights_digest: weights_file::digest(&numbers(params.len(), 9)),
            ..Best::default()
        };
        TrainingState {
            best: Some(numbers(params.len(), 9)),
            learner: learner.collect(),
            snapshots: vec![Snapshot::new(4, 90, &acting), Snapshot::new(5, 100, &acting)],
            manifest: Manifest {
                origin: Origin::of(&self.run_dir, &self.config).unwrap(),
                env_steps_before: env_steps - 2,
                progress: Progress { env_steps, episodes: 10, updates: 5 },
                target_copied_at: 3,
                terms: [4, 5].map(|weights_version| Terms { weights_version, epsilon: 0.1 + 0.2 }).to_vec(),
                snapshots: [(4, 90), (5, 100)]
                    .map(|(version, env_steps)| SnapshotMark { version, env_steps })
                    .to_vec(),
                recent: vec![vec![(0.1 + 0.2, true)], vec![]],
                exploring: vec![Exploring { episodes_total: 9, policy_lag: 1 }],
                metrics_len: 77,
                tensorboard: Position { file: "events".into(), len: 55 },
                wall_s: 1.5,
                cpu_s: 2.5,
                evaluation: None,
                best: Some(best),
                weights_digest: weights_file::digest(&params),
            },
            params,
        }
    }

    fn save(&self, env_steps: u64) -> PathBuf {
        self.save_and_keep(env_steps, 3)
    }

    fn save_and_keep(&self, env_steps: u64, keep: usize) -> PathBuf {
        let saved =
            save(&self.run_dir, &self.model, &TaskNames::of(&self.config), &self.state(env_steps), keep);
        self.run_dir.root().join(saved.unwrap())
    }

    /// The names of what counts as a checkpoint, oldest first.
    fn names(&self) -> Vec<String> {
        let folders = folders::list(&self.run_dir.checkpoints()).unwrap();
        folders.iter().map(|folder| folder.path.file_name().unwrap().to_str().unwrap().to_owned()).collect()
    }

    fn refusal(&self) -> String {
        self.load().unwrap_err().to_string()
    }

    fn load(&self) -> Result<Option<Loaded>, CheckpointError> {
        let dims = rit_env::TaskSet::MatrixGame.dims();
        let layout = PayloadLayout::new(dims);
        let tasks = vec![TaskSize { n_agents: 2, n_entities: 2 }; 2];
        let expected = Expected { run_id: self.run_dir.run_id(), layout, tasks };
        load_newest(&self.run_dir, &*self.learner, &expected, &self.config)
    }
}

#[test]
fn a_state_comes_back_whole_and_latest_is_the_newest() {
    let run = run();
    assert!(run.load().unwrap().is_none(), "none was ever written");
    run.save(50);
    run.save(100);
    let loaded = run.load().unwrap().unwrap();
    assert_eq!(loaded.state, run.state(100));
    assert!(loaded.warnings.is_empty());
    let latest = run.run_dir.checkpoints().join(LATEST);
    assert_eq!(load(&latest, &*run.learner, 2, &run.config.algorithm).unwrap(), run.state(100));
    run.save(100);
    assert_eq!(run.load().unwrap().unwrap().state, run.state(100), "once more by request");
}

#[test]
fn only_the_last_few_are_kept() {
    let run = run();
    for env_steps in [10, 20, 30, 40, 50] {
        run.save(env_steps);
    }
    assert_eq!(run.names(), ["step-000000000030", "step-000000000040", "step-000000000050"]);
}

#[test]
fn a_damaged_newest_is_reported_and_the_one_before_is_used() {
    for name in [WEIGHTS, BEST, STATE, MANIFEST, SUMS] {
        let run = run();
        run.save(10);
        let newest = run.save(20);
        let path = newest.join(name);
        let mut bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&path, bytes).unwrap();
        let loaded = run.load().unwrap().unwrap();
        assert_eq!(loaded.state, run.state(10), "{name}");
        let [warning] = &loaded.warnings[..] else { panic!("{:?}", loaded.warnings) };
        let said = ["a checkpoint is damaged, the one at 10 steps is used", "was altered", "20.damaged now"];
        assert!(said.iter().all(|part| warning.contains(part)), "{name}: {warning}");
        assert_eq!(run.names(), ["step-000000000010"], "it does not count any more");

        fs::remove_file(run.save(30).join(name)).unwrap();
        assert!(run.load().unwrap().unwrap().warnings[0].contains("No such file"), "{name}");
    }
}

#[test]
fn a_manifest_that_was_rewritten_with_its_sum_is_refused_for_what_it_says() {
    let run = run();
    run.save(10);
    let newest = run.save(20);
    let read = |name: &str| fs::read_to_string(newest.join(name)).unwrap();
    let (manifest, sums) = (read(MANIFEST), read(SUMS));
    let rewritten = manifest.replace("\"updates\": 5", "\"updates\": 11");
    let sum = |text: &str| sha256(text.as_bytes());
    fs::write(newest.join(MANIFEST), &rewritten).unwrap();
    fs::write(newest.join(SUMS), sums.replace(&sum(&manifest), &sum(&rewritten))).unwrap();
    let loaded = run.load().unwrap().unwrap();
    assert_eq!(loaded.state, run.state(10));
    let message = &loaded.warnings[0];
    assert!(message.contains("checkpoint.json: 11 updates are more than 10 batches"), "{message}");
}

#[test]
fn what_was_half_written_is_nothing() {
    let run = run();
    run.save(10);
    let partial = run.run_dir.checkpoints().join("step-000000000020.partial");
    fs::create_dir(&partial).unwrap();
    fs::write(partial.join(WEIGHTS), "half").unwrap();
    let loaded = run.load().unwrap().unwrap();
    assert_eq!((loaded.state, loaded.warnings.len()), (run.state(10), 0));
    run.save(20);
    assert_eq!(run.load().unwrap().unwrap().state, run.state(20));
}

#[test]
fn never_a_silent_fresh_start() {
    let run = run();
    for folder in [run.save(10), run.save(20)] {
        fs::write(folder.join(SUMS), "").unwrap();
    }
    let message = run.load().unwrap_err().to_string();
    assert!(message.contains("no checkpoint in") && message.contains("step-000000000020"), "{message}");
}

#[test]
fn a_run_whose_checkpoints_are_gone_is_no_new_run() {
    let gone = "this run has written some (the newest: step-000000000020); put them back, or begin a new run";
    for keep_latest in [false, true] {
        let run = run();
        [10, 20].into_iter().for_each(|env_steps| fs::remove_dir_all(run.save(env_steps)).unwrap());
        if !keep_latest {
            fs::remove_file(run.run_dir.checkpoints().join(LATEST)).unwrap();
        }
        assert!(run.refusal().contains(gone), "{}", run.refusal());
        // Each trace alone tells of them.
        fs::remove_file(run.run_dir.root().join("checkpoints.json")).unwrap();
        match keep_latest {
            true => assert!(run.refusal().contains(gone), "{}", run.refusal()),
            false => {
                assert!(run.load().unwrap().is_none(), "nothing tells of them any more");
            }
        }
        fs::remove_dir_all(run.run_dir.checkpoints()).unwrap();
        fs::write(run.run_dir.root().join("checkpoints.json"), "{").unwrap();
        assert!(run.refusal().contains("checkpoints.json tells of it"), "{}", run.refusal());
    }
}

#[test]
fn a_checkpoint_of_another_run_or_of_other_settings_is_refused_and_nothing_is_touched() {
    let (run, other) = (run(), run());
    let mine = run.save(20);
    let theirs = other.save(10);
    let foreign = run.run_dir.checkpoints().join(theirs.file_name().unwrap());
    fs::rename(theirs, &foreign).unwrap();
    let message = run.refusal();
    assert!(message.contains("step-000000000010: it is of another run"), "{message}");
    assert!(foreign.exists() && mine.exists());
    fs::remove_dir_all(foreign).unwrap();

    let mut edited = run;
    edited.config.seed = RunSeed(9);
    let message = edited.refusal();
    assert!(
        message.contains("step-000000000020: it was trained with seed = 1, config.toml says 9"),
        "{message}"
    );
    edited.config.seed = RunSeed(1);
    edited.config.algorithm.gamma = 0.5;
    assert!(
        edited.refusal().contains("algorithm.gamma = 0.99, config.toml says 0.5"),
        "{}",
        edited.refusal()
    );
    edited.config.algorithm.gamma = 0.99;
    // What can change while a learner runs may have changed since.
    edited.config.algorithm.epsilon_finish = 0.25;
    let warnings = edited.load().unwrap().unwrap().warnings;
    assert!(
        warnings[0].starts_with("algorithm.epsilon_finish is 0.25 from here on, it was 0.05"),
        "{warnings:?}"
    );
}

#[test]
fn fewer_steps_than_are_done_are_refused_and_as_many_are_not() {
    let mut run = run();
    run.save(400);
    // Its last batch went from 398 to 400.
    for (t_max, accepted) in [(399, true), (400, true), (1000, true), (398, false), (5, false)] {
        run.config.training.t_max = t_max;
        assert_eq!(run.load().is_ok(), accepted, "{t_max}");
    }
    assert!(
        run.refusal().starts_with("training.t_max = 5, and 400 steps are done already"),
        "{}",
        run.refusal()
    );
}

#[test]
fn a_renamed_copy_is_not_the_newest_and_evicts_no_other() {
    let run = run();
    let real = run.save(10);
    let copy = run.run_dir.checkpoints().join("step-999999999999");
    fs::create_dir(&copy).unwrap();
    for entry in fs::read_dir(&real).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, copy.join(path.file_name().unwrap())).unwrap();
    }
    let loaded = run.load().unwrap().unwrap();
    assert_eq!((loaded.state, loaded.folder), (run.state(10), real.clone()));
    assert!(loaded.warnings[0].contains("holds the checkpoint at 10 steps and is called otherwise"));
    run.save_and_keep(20, 1);
    assert_eq!(run.names(), ["step-000000000020", "step-999999999999"], "it is left alone");
    assert_eq!(run.load().unwrap().unwrap().state, run.state(20));
    fs::remove_dir_all(run.run_dir.checkpoints().join("step-000000000020")).unwrap();
    assert!(run.refusal().contains("is called otherwise"), "{}", run.refusal());
}

#[test]
fn with_one_kept_the_last_good_one_survives_a_damaged_newest() {
    let run = run();
    run.save_and_keep(10, 2);
    fs::write(run.save_and_keep(20, 2).join(STATE), "damaged").unwrap();
    assert_eq!(run.load().unwrap().unwrap().state, run.state(10));
    // Training goes on from 10, and its next checkpoint comes before the step of the damaged one.
    run.save_and_keep(15, 1);
    assert_eq!(run.names(), ["step-000000000015"]);
    assert_eq!(run.load().unwrap().unwrap().state, run.state(15));
}

#[test]
fn what_a_person_put_there_is_not_read_for_ever() {
    let run = run();
    run.save(10);
    let newest = run.save(20);
    fs::remove_file(newest.join(WEIGHTS)).unwrap();
    symlink("/dev/zero", newest.join(WEIGHTS)).unwrap();
    let loaded = run.load().unwrap().unwrap();
    assert_eq!(loaded.state, run.state(10));
    assert!(loaded.warnings[0].contains("it is no regular file"), "{:?}", loaded.warnings);
}

/// At any moment there is a checkpoint to find, as a learner must that is started after a kill at that moment.
#[test]
fn at_every_moment_of_repeating_a_checkpoint_there_is_one() {
    let run = run();
    run.save(100);
    let latest = run.run_dir.checkpoints().join(LATEST);
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let looking = scope.spawn(|| {
            let mut seen = BTreeSet::new();
            while !done.load(Ordering::Relaxed) {
                let target = fs::read_link(&latest).unwrap();
                // The old one goes once the link leads to the new one.
                let manifest = fs::read(run.run_dir.checkpoints().join(&target).join(MANIFEST));
                assert!(
                    manifest.is_ok() || fs::read_link(&latest).unwrap() != target,
                    "{}",
                    target.display()
                );
                seen.insert(target);
            }
            seen.len()
        });
        (0..40).for_each(|_| drop(run.save(100)));
        done.store(true, Ordering::Relaxed);
        assert!(looking.join().unwrap() > 1, "it looked while they were written");
    });
    assert_eq!(run.names(), ["step-000000000100-41"], "one of each step is kept");
    assert_eq!(run.load().unwrap().unwrap().state, run.state(100));
}

#[test]
fn wherever_writing_was_cut_short_the_next_learner_goes_on() {
    let all = |run: &Run| run.run_dir.checkpoints();
    let cut: [fn(&Path); 4] = [
        // Written, not renamed.
        |all| fs::rename(all.join("step-000000000100-2"), all.join("step-000000000100-2.partial")).unwrap(),
        // Renamed, and the link still leads to the one before.
        |all| {
            fs::remove_file(all.join(LATEST)).unwrap();
            symlink("step-000000000100", all.join(LATEST)).unwrap();
        },
        // The first one of the run, not yet remembered.
        |all| fs::remove_file(all.join("../checkpoints.json")).unwrap(),
        // Linked, and the one before still there: as it lies.
        |_| (),
    ];
    for cut in cut {
        let run = run();
        let before = run.save(100);
        let copy = all(&run).join("copy");
        fs::rename(&before, &copy).unwrap();
        fs::create_dir(&before).unwrap();
        run.save(100);
        fs::remove_dir_all(&before).ok();
        fs::rename(&copy, &before).unwrap();
        cut(&all(&run));
        assert_eq!(run.load().unwrap().unwrap().state, run.state(100));
        run.save(100);
        run.save(200);
        assert_eq!(run.load().unwrap().unwrap().state, run.state(200));
        assert!(!all(&run).join("step-000000000100-2.partial").exists());
    }
}

#[test]
fn readers_of_the_weights_alone_are_told_whose_they_are() {
    let (run, other) = (run(), run());
    let of = |run: &Run, which| weights(&run.run_dir, &run.config, which);
    let latest = |run: &Run| of(run, Which::Latest);
    assert!(latest(&run).unwrap().is_none(), "none was ever written");
    let folder = run.save(20);
    assert_eq!(fs::canonicalize(latest(&run).unwrap().unwrap()).unwrap(), folder.join(WEIGHTS));
    let best = of(&run, Which::Best).unwrap().unwrap();
    let best = weights_file::load(&best, run.learner.layout()).unwrap();
    assert_eq!(Some(best), run.state(20).best);
    assert_eq!(of(&run, Which::Step(20)).unwrap(), Some(folder.join(WEIGHTS)));
    let elsewhere = of(&run, Which::Step(30)).unwrap_err().to_string();
    assert!(elsewhere.ends_with("holds no checkpoint at 30 steps; there are: step-20"), "{elsewhere}");
    let mut edited = run;
    edited.config.algorithm.gamma = 0.5;
    assert!(latest(&edited).unwrap().is_some(), "weights do what they do");
    fs::remove_dir_all(&folder).unwrap();
    fs::rename(other.save(20), &folder).unwrap();
    assert!(latest(&edited).unwrap_err().to_string().contains("it is of another run"));
    fs::remove_dir_all(&folder).unwrap();
    assert!(
        latest(&edited)
            .unwrap_err()
            .to_string()
            .contains("holds no checkpoint, and this run has written some")
    );
}

#[test]
fn a_checkpoint_is_written_though_old_replay_cannot_be_removed() {
    let run = run();
    let mut state = run.state(2000);
    state.manifest.progress.episodes = 2000;
    let (replay, layout) = (run.run_dir.replay(), PayloadLayout::new(run.config.dims()));
    let log = ReplayLog::open(&replay, layout, run.run_dir.lineage(), 2000).unwrap();
    // It is called like a file of replay, and is removed in another way.
    fs::create_dir(replay.join("000000000000.frames")).unwrap();
    let (events, mut told) = tokio::sync::mpsc::channel(1);
    let writer = Writer {
        run_dir: run.run_dir.clone(),
        model: Arc::new(Model::new(run.config.model()).unwrap()),
        names: TaskNames::of(&run.config),
        log,
        replay_episodes: 0,
        keep: 3,
        events,
    };
    let (queue, reader) = write_queue(0);
    let (answer, answered) = tokio::sync::oneshot::channel();
    queue.checkpoint(Box::new(state), Some(answer));
    drop(queue);
    writer.run(&reader);
    assert_eq!(answered.blocking_recv().unwrap(), Ok("checkpoints/step-000000002000".into()));
    let ended = told.blocking_recv();
    let Some(Event::Input(Input::CheckpointEnded(ended))) = ended else { panic!("{ended:?}") };
    assert_eq!((ended.env_steps, ended.failed), (2000, None));
    assert!(replay.join("000000000000.frames").exists(), "it could not be removed");
    assert_eq!(run.names(), ["step-000000002000"]);
}

#[test]
fn a_checkpoint_without_a_best_policy_says_so() {
    let run = run();
    let mut state = run.state(20);
    (state.best, state.manifest.best) = (None, None);
    save(&run.run_dir, &run.model, &TaskNames::of(&run.config), &state, 3).unwrap();
    assert_eq!(run.load().unwrap().unwrap().state, state);
    let none = weights(&run.run_dir, &run.config, Which::Best).unwrap_err().to_string();
    assert!(none.contains("keeps no best policy: checkpoints.keep_best was not set"), "{none}");
}
