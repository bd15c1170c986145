use super::*;
use crate::{Physics, conformance};

fn all_tasks(set: TaskSet) -> Vec<Task> {
    [set.tasks(Split::Training), set.tasks(Split::Testing)].concat()
}

#[test]
fn every_task_of_every_set_conforms() {
    for set in TaskSet::ALL {
        // Battles are long and there are many: every tenth, from the smallest to the largest.
        let step = if matches!(set, TaskSet::Combat(_)) { 10 } else { 1 };
        for task in all_tasks(set).into_iter().step_by(step) {
            conformance::check(|| task.environment(EnvironmentOptions::default()));
        }
        let otherwise = EnvironmentOptions {
            view_radius: Some(0.5),
            approach_shaping: 0.5,
            physics: Physics::Mpe2,
            ..Default::default()
        };
        conformance::check(|| set.tasks(Split::Training)[0].environment(otherwise));
    }
}

#[test]
fn dims_hold_every_task() {
    for set in TaskSet::ALL {
        let dims = set.dims();
        assert_eq!(dims.validate(), Ok(()));
        for task in all_tasks(set) {
            let size = task.size();
            assert!(size.n_agents <= dims.agents_max, "{task}");
            assert!(size.n_entities - size.n_agents <= dims.entities_max - dims.agents_max, "{task}");
        }
    }
    // Six agents and six landmarks; five predators, two obstacles and two prey.
    for (set, agents_max, entities_max) in [
        (TaskSet::CooperativeNavigation, 6, 12),
        (TaskSet::PredatorPrey, 5, 9),
        (TaskSet::PredatorPreyPro, 5, 9),
    ] {
        let expected = Dims { entity_dim: 12, n_actions: 5, agents_max, entities_max, steps_max: 25 };
        assert_eq!(set.dims(), expected, "{set}");
    }
}

#[test]
fn tasks_are_those_of_the_paper() {
    let hunts = [["2-1", "3-1", "3-2"].as_slice(), ["4-2", "5-2"].as_slice()];
    for (set, prefix, sizes) in [
        (TaskSet::MatrixGame, "game", [["1", "2", "3", "4"].as_slice(), &[]]),
        (TaskSet::CooperativeNavigation, "navigation", [&["2-2", "3-3", "4-4"], &["5-5", "6-6"]]),
        (TaskSet::PredatorPrey, "predator-prey", hunts),
        (TaskSet::PredatorPreyPro, "predator-prey-pro", hunts),
    ] {
        for (split, sizes) in [Split::Training, Split::Testing].into_iter().zip(sizes) {
            let names: Vec<String> = set.tasks(split).iter().map(Task::to_string).collect();
            let expected: Vec<String> = sizes.iter().map(|size| format!("{prefix}-{size}")).collect();
            assert_eq!(names, expected);
        }
    }
}

#[test]
fn names_lead_back() {
    for set in TaskSet::ALL {
        assert_eq!(set.to_string().parse(), Ok(set));
        for task in all_tasks(set) {
            assert_eq!(set.task(&task.to_string()), Ok(task));
        }
    }
    let unknown = "matrixgame".parse::<TaskSet>().unwrap_err();
    assert!(unknown.to_string().starts_with("unknown task set \"matrixgame\"; known: matrix-game"));
    assert_eq!(TaskSet::Combat(CombatSet::Marines).to_string(), "3-8m");
    assert_eq!(
        TaskSet::CooperativeNavigation.task("predator-prey-3-1").unwrap_err().to_string(),
        "unknown task \"predator-prey-3-1\"; known: navigation-2-2, navigation-3-3, navigation-4-4, \
         navigation-5-5, navigation-6-6"
    );
}

#[test]
fn tasks_beyond_the_lists_have_names_too() {
    for (set, name) in [
        (TaskSet::CooperativeNavigation, "navigation-8-8"),
        (TaskSet::PredatorPrey, "predator-prey-6-3"),
        (TaskSet::PredatorPreyPro, "predator-prey-pro-2-2"),
        (TaskSet::Combat(CombatSet::StalkersZealots), "1s7z"),
        (TaskSet::Combat(CombatSet::Marines), "3m-vs-4m"),
    ] {
        assert_eq!(set.task(name).map(|task| task.to_string()).as_deref(), Ok(name));
    }
    let refused = |set: TaskSet, name: &str| set.task(name).unwrap_err().to_string();
    assert_eq!(
        refused(TaskSet::CooperativeNavigation, "navigation-0-0"),
        "navigation-0-0: agents must be 1 to 64"
    );
    assert_eq!(refused(TaskSet::Combat(CombatSet::Marines), "9m"), "9m has 9 units; a side has 1 to 8");
    for name in [
        "navigation-2-3",
        "navigation-2",
        "navigation--2-2",
        "navigation-07-7",
        "navigation-+7-7",
        "navigation-7-+7",
        "game-5",
        "",
    ] {
        assert!(refused(TaskSet::CooperativeNavigation, name).starts_with("unknown task"), "{name}");
    }
    for name in ["predator-prey-06-3", "predator-prey-6-+3"] {
        assert!(refused(TaskSet::PredatorPrey, name).starts_with("unknown task"), "{name}");
    }
    // Other names of one battle are understood.
    let marines = TaskSet::Combat(CombatSet::Marines);
    assert_eq!(marines.task("3m-vs-3m"), marines.task("3m"));
}

/// A spec says what its world does.
#[test]
fn specs_are_the_worlds_own() {
    for set in TaskSet::ALL {
        for task in all_tasks(set) {
            let environment = task.environment(EnvironmentOptions::default());
            assert_eq!(environment.spec(), task.spec(), "{task}");
            assert_eq!(task.spec().has_wins, set.has_wins());
            assert_eq!(environment.scene().is_some(), task.spec().has_scenes, "{task}");
        }
    }
}
