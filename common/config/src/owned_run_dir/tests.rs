use super::*;
use crate::{
    resolve,
    run_lock::tests::{NoProcessStarts, no_process_starts},
};
use std::{os::unix::fs::symlink, sync::Barrier, thread};
use tempfile::TempDir;

fn config() -> Config {
    resolve("environment.task_set = \"matrix-game\"\nseed = 5", "test", &[]).unwrap()
}

/// A place for runs, whose locks are free as soon as they are given up.
struct Folder {
    place: TempDir,
    _no_process_starts: NoProcessStarts,
}

impl Folder {
    fn path(&self) -> &Path {
        self.place.path()
    }
}

fn folder() -> (Folder, PathBuf) {
    let folder = Folder { place: tempfile::tempdir().unwrap(), _no_process_starts: no_process_starts() };
    let root = folder.path().join("run");
    (folder, root)
}

/// As `cp -a` copies a folder.
fn copy(from: &Path, to: &Path) {
    fs::create_dir(to).unwrap();
    fs::set_permissions(to, fs::metadata(from).unwrap().permissions()).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let (entry, to) = entry.map(|entry| (entry.path(), to.join(entry.file_name()))).unwrap();
        if let Ok(target) = fs::read_link(&entry) {
            symlink(target, to).unwrap();
        } else if entry.is_dir() {
            copy(&entry, &to);
        } else {
            fs::copy(&entry, &to).unwrap();
        }
    }
}

/// Every file below a folder with what it holds, but for the lock's, which names the process that looked last.
fn contents(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut all = Vec::new();
    for entry in fs::read_dir(root).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            all.extend(contents(&path));
        } else if !path.ends_with(LOCK) {
            all.push((path.clone(), fs::read(&path).unwrap()));
        }
    }
    all.sort();
    all
}

#[test]
fn what_is_created_can_be_opened_and_nothing_is_written_over() {
    let (folder, _) = folder();
    let root = folder.path().join("a/b");
    let made = OwnedRunDir::create(&root, &config()).unwrap();
    let (opened, read) = RunDir::open(&root).unwrap();
    assert_eq!((made.run_dir(), config()), (&opened, read));
    assert_eq!(fs::metadata(&root).unwrap().permissions().mode() & 0o777, 0o700);
    assert!(matches!(OwnedRunDir::create(&root, &config()), Err(RunDirError::Occupied(_))));
    let other = OwnedRunDir::create(&folder.path().join("c"), &config()).unwrap();
    let (made, other) = (made.run_dir(), other.run_dir());
    assert_ne!((made.run_id(), made.token()), (other.run_id(), other.token()));
    assert_eq!(made.lineage(), made.run_id());
}

#[test]
fn a_run_goes_on_with_other_settings_unless_they_change_the_result() {
    let (_folder, root) = folder();
    drop(OwnedRunDir::create(&root, &config()).unwrap());
    let resume = |text: &str| OwnedRunDir::resume(&root, &[crate::set(text).unwrap()]);
    let (owned, longer) = resume("training.t_max=70000").unwrap();
    assert_eq!(longer.training.t_max, 70_000);
    drop(owned);
    let (owned, more) = resume("actors.count=5").unwrap();
    assert_eq!((more.training.t_max, more.actors.count), (70_000, 5), "what was set stays set");
    drop(owned);
    for setting in ["algorithm.gamma=0.5", "seed=6", "learner.shards=3", "network.hidden_dim=8"] {
        let before = contents(&root);
        let error = resume(setting).unwrap_err().to_string();
        let key = setting.split('=').next().unwrap();
        assert!(error.contains(key) && error.contains("cannot change"), "{error}");
        assert_eq!(contents(&root), before, "a refused resume changes nothing");
    }
    assert_eq!(RunDir::open(&root).unwrap().1, more);
}

#[test]
fn the_second_process_is_refused_and_touches_nothing() {
    let (_folder, root) = folder();
    let made = OwnedRunDir::create(&root, &config()).unwrap();
    let before = contents(&root);
    for _ in 0..2 {
        let error = OwnedRunDir::resume(&root, &[crate::set("actors.count=5").unwrap()]).unwrap_err();
        assert!(error.to_string().contains(&format!("in use by process {}", std::process::id())), "{error}");
        assert!(matches!(OwnedRunDir::open(&root, false), Err(RunDirError::InUse { .. })));
    }
    assert_eq!(contents(&root), before);
    drop(made);
    OwnedRunDir::open(&root, true).unwrap();
}

#[test]
fn starts_in_one_folder_at_the_same_moment_count_up() {
    let (folder, _) = folder();
    let starts = 8;
    let together = Barrier::new(starts);
    let mut names: Vec<_> = thread::scope(|scope| {
        let start = || {
            together.wait();
            let made = OwnedRunDir::create_fresh(&folder.path().join("runs"), "matrix-game", &config());
            made.unwrap().run_dir().root().file_name().unwrap().to_str().unwrap().to_owned()
        };
        let threads: Vec<_> = (0..starts).map(|_| scope.spawn(start)).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    names.sort();
    let expected: Vec<_> = (1..=starts).map(|n| format!("matrix-game-{n}")).collect();
    assert_eq!(names, expected);
}

#[test]
fn starts_in_one_empty_folder_at_the_same_moment_are_one() {
    let (_folder, root) = folder();
    fs::create_dir(&root).unwrap();
    let starts = 8;
    let together = Barrier::new(starts);
    let made = thread::scope(|scope| {
        let start = || {
            together.wait();
            OwnedRunDir::create(&root, &config())
        };
        let threads: Vec<_> = (0..starts).map(|_| scope.spawn(start)).collect();
        let made: Vec<_> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
        made.into_iter().filter_map(Result::ok).count()
    });
    assert_eq!(made, 1);
}

#[test]
fn what_is_no_place_for_a_run_is_said_and_left_alone() {
    let (folder, root) = folder();
    let error = |root: &Path| OwnedRunDir::create(root, &config()).unwrap_err().to_string();
    fs::create_dir(&root).unwrap();
    fs::write(root.join("thesis.tex"), "mine").unwrap();
    assert!(error(&root).contains("is not empty, thesis.tex lies there"), "{}", error(&root));
    assert_eq!(fs::read_dir(&root).unwrap().count(), 1);
    let file = root.join("thesis.tex");
    assert!(error(&file).contains("is a file and no directory"), "{}", error(&file));
    let link = folder.path().join("link");
    symlink("gone", &link).unwrap();
    assert!(error(&link).contains("is a link to gone"), "{}", error(&link));
}

#[test]
fn a_run_that_never_began_leaves_what_was_there_before() {
    let (_folder, root) = folder();
    OwnedRunDir::create(&root, &config()).unwrap().undo().unwrap();
    assert!(!root.exists());

    // A folder of the user's own stays, and so does what was put there meanwhile.
    fs::create_dir(&root).unwrap();
    OwnedRunDir::create(&root, &config()).unwrap().undo().unwrap();
    assert_eq!(contents(&root), []);
    let made = OwnedRunDir::create(&root, &config()).unwrap();
    fs::write(root.join("notes"), "mine").unwrap();
    fs::write(made.run_dir().logs().join("notes"), "mine").unwrap();
    fs::write(made.run_dir().logs().join("actor-0.log"), "the run's").unwrap();
    made.undo().unwrap();
    let left: Vec<_> = contents(&root).into_iter().map(|(path, _)| path).collect();
    assert_eq!(left, [root.join("logs/notes"), root.join("notes")]);
}

#[test]
fn a_resume_that_failed_leaves_the_run_as_it_was() {
    let (_folder, root) = folder();
    drop(OwnedRunDir::create(&root, &config()).unwrap());
    let before = contents(&root);
    let (owned, _) = OwnedRunDir::resume(&root, &[crate::set("actors.count=5").unwrap()]).unwrap();
    assert_ne!(contents(&root), before);
    owned.undo().unwrap();
    assert_eq!(contents(&root), before);
}

#[test]
fn a_copy_gets_an_identity_of_its_own_and_keeps_its_files_lineage() {
    let (folder, root) = folder();
    let made = OwnedRunDir::create(&root, &config()).unwrap();
    fs::write(made.run_dir().web(), "http://127.0.0.1:1/?token=theirs").unwrap();
    let before = contents(&root);
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    copy(&root, &first);
    copy(&root, &second);
    let resume = |root: &Path| OwnedRunDir::resume(root, &[]).unwrap().0;
    let copies = [resume(&first), resume(&second)];
    for copy in &copies {
        let ours = copy.run_dir();
        assert_ne!((ours.run_id(), ours.token()), (made.run_dir().run_id(), made.run_dir().token()));
        assert_eq!(ours.lineage(), made.run_dir().lineage());
        assert_eq!(ours, &RunDir::open(ours.root()).unwrap().0);
        assert!(!ours.web().exists(), "it led to the other's learner");
        let [notice] = copy.notices() else { panic!("{:?}", copy.notices()) };
        assert!(notice.contains(&format!("is a copy of {}", root.display())), "{notice}");
    }
    assert_ne!(copies[0].run_dir().run_id(), copies[1].run_dir().run_id());
    assert_eq!(contents(&root), before, "the original is not touched");
    // From then on it is a run like any other, and so is a copy of it.
    let run_id = copies[0].run_dir().run_id();
    drop(copies);
    let again = resume(&first);
    assert_eq!((again.run_dir().run_id(), again.notices()), (run_id, &[][..]));
    let third = folder.path().join("third");
    copy(&first, &third);
    let of_a_copy = resume(&third);
    assert_ne!(of_a_copy.run_dir().run_id(), run_id);
    assert_eq!(of_a_copy.run_dir().lineage(), made.run_dir().lineage());
}

#[test]
fn what_lies_in_the_place_of_a_file_is_named() {
    let (folder, root) = folder();
    OwnedRunDir::create(&root, &config()).unwrap();
    let other = folder.path().join("other");
    copy(&root, &other);
    fs::create_dir(other.join("web")).unwrap();
    let wrong = OwnedRunDir::resume(&other, &[]).unwrap_err().to_string();
    assert!(wrong.contains("other/web: Is a directory"), "{wrong}");
    fs::remove_file(root.join("config.toml")).unwrap();
    symlink("gone.toml", root.join("config.toml")).unwrap();
    let wrong = OwnedRunDir::resume(&root, &[]).unwrap_err().to_string();
    assert!(wrong.contains("config.toml: it is a link to gone.toml, which does not exist"), "{wrong}");

    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    for (place, words) in [
        (file.join("run"), "file is a file and no directory"),
        (file.join("deep/run"), "file is a file and no directory"),
        (PathBuf::from("/proc/run"), "/proc/run cannot be made"),
    ] {
        let wrong = OwnedRunDir::create(&place, &config()).unwrap_err().to_string();
        assert!(wrong.contains(words), "{wrong}");
        let wrong = OwnedRunDir::create_fresh(&place, "run", &config()).unwrap_err().to_string();
        assert!(wrong.contains(words), "{wrong}");
    }
}

#[test]
fn a_run_that_was_moved_stays_what_it_was() {
    let (folder, root) = folder();
    let made = OwnedRunDir::create(&root, &config()).unwrap().run_dir().clone();
    let identity = |root: &Path| {
        let (owned, _) = OwnedRunDir::resume(root, &[]).unwrap();
        assert_eq!(owned.notices(), [""; 0]);
        owned.run_dir().run_id()
    };
    // Renamed; then to another file system, say, or through a backup: by a copy whose original is gone.
    let (renamed, moved) = (folder.path().join("renamed"), folder.path().join("moved"));
    fs::rename(&root, &renamed).unwrap();
    assert_eq!(identity(&renamed), made.run_id());
    copy(&renamed, &moved);
    fs::remove_dir_all(&renamed).unwrap();
    assert_eq!(identity(&moved), made.run_id());
    // Another run where it was.
    OwnedRunDir::create(&renamed, &config()).unwrap();
    assert_eq!(identity(&moved), made.run_id());
    // Brought back to where it was, in another folder.
    copy(&moved, &root);
    fs::remove_dir_all(&moved).unwrap();
    fs::rename(&root, &moved).unwrap();
    assert_eq!(identity(&moved), made.run_id());
}
