//! What the paper has: its task sets, methods, figures, and the numbers of its tables III to V (section VI).

use crate::{comparison::NO_PERMUTATION, figures::Drawn};
use rit_algo::Method;
use rit_env::TaskSet;

/// A task set and what the paper says of each method there: mean and standard error over five seeds, zero-shot.
type Column = (&'static str, &'static [(&'static str, f64, f64)]);

/// A table of the paper's zero-shot results.
pub struct PaperTable {
    /// Its number.
    pub number: &'static str,
    /// What it shows.
    pub title: &'static str,
    /// Its methods, in its order.
    pub methods: &'static [&'static str],
    /// Its task sets, in its order.
    pub columns: &'static [Column],
}

/// A figure of learning curves.
pub struct PaperFigure {
    /// Its number.
    pub number: u8,
    /// What it shows.
    pub title: &'static str,
    /// Its task sets, in its order.
    pub task_sets: &'static [&'static str],
    /// Its methods; all where empty.
    pub methods: &'static [&'static str],
    /// Whether its runs learn a single task.
    pub single_task: bool,
    /// What its lines and bands are.
    pub drawn: Drawn,
}

const RIVALS: [&str; 10] =
    ["rit", "rit-vdn", "refil", "updet-mix", "updet-vdn", "qmix-attn", "vdn-attn", "roma", "mappo", "mat"];
const NAVIGATION: &str = "cooperative-navigation";
const NO_TASKS: &str = "rit-no-task-representations";
const NO_ORDER: &str = "rit-no-random-permutation";

/// Figures 2 to 5.
pub const FIGURES: [PaperFigure; 4] = [
    PaperFigure {
        number: 2,
        title: "Multi-task performance: matrix game and particle worlds",
        task_sets: &["matrix-game", NAVIGATION, "predator-prey", "predator-prey-pro"],
        methods: &[],
        single_task: false,
        drawn: Drawn::MeanAndDeviation,
    },
    PaperFigure {
        number: 3,
        title: "Multi-task performance: StarCraft micro-combat",
        task_sets: &["3-8m", "3-8sz", "3-8MMM", "3-8csz"],
        methods: &[],
        single_task: false,
        drawn: Drawn::MedianAndError,
    },
    PaperFigure {
        number: 4,
        title: "Ablations, multi-task",
        task_sets: &[NAVIGATION, "3-8MMM", "3-8csz", "3-8sz"],
        methods: &["rit", NO_ORDER, NO_TASKS, "qmix-attn"],
        single_task: false,
        drawn: Drawn::MeanAndDeviation,
    },
    PaperFigure {
        number: 5,
        title: "The random permutation of the decision order, single-task",
        task_sets: &["3-8m", "3-8sz", "3-8MMM", "3-8csz"],
        methods: &["qmix-int", "qmix-int-no-random-permutation", "vdn-int", "vdn-int-no-random-permutation"],
        single_task: true,
        drawn: Drawn::MeanAndDeviation,
    },
];

/// Tables III to V.
pub const TABLES: [PaperTable; 3] = [
    PaperTable {
        number: "III",
        title: "Zero-shot performance, particle worlds (return)",
        methods: &RIVALS,
        columns: &[
            (
                NAVIGATION,
                &[
                    ("rit", -342.4, 14.1),
                    ("rit-vdn", -376.1, 17.9),
                    ("refil", -493.0, 18.8),
                    ("updet-mix", -454.8, 22.6),
                    ("updet-vdn", -459.8, 20.4),
                    ("qmix-attn", -418.5, 20.2),
                    ("vdn-attn", -415.1, 18.6),
                    ("roma", -1081.6, 303.8),
                    ("mappo", -478.0, 7.7),
                    ("mat", -524.0, 29.0),
                ],
            ),
            (
                "predator-prey",
                &[
                    ("rit", 6.5, 1.5),
                    ("rit-vdn", 5.6, 1.3),
                    ("refil", 4.4, 1.3),
                    ("updet-mix", 6.9, 1.8),
                    ("updet-vdn", 6.6, 0.7),
                    ("qmix-attn", 5.5, 0.9),
                    ("vdn-attn", 3.8, 1.4),
                    ("roma", 5.3, 1.2),
                    ("mappo", 1.1, 0.6),
                    ("mat", 1.2, 0.3),
                ],
            ),
            (
                "predator-prey-pro",
                &[
                    ("rit", -52.2, 5.4),
                    ("rit-vdn", -49.9, 3.4),
                    ("refil", -54.0, 3.9),
                    ("updet-mix", -55.7, 2.6),
                    ("updet-vdn", -53.9, 4.5),
                    ("qmix-attn", -55.8, 4.3),
                    ("vdn-attn", -52.1, 3.2),
                    ("roma", -57.9, 3.7),
                    ("mappo", -95.1, 3.3),
                    ("mat", -98.6, 5.6),
                ],
            ),
        ],
    },
    PaperTable {
        number: "IV",
        title: "Zero-shot performance, StarCraft micro-combat (win rate)",
        methods: &RIVALS,
        columns: &[
            (
                "3-8csz",
                &[
                    ("rit", 0.70, 0.07),
                    ("rit-vdn", 0.50, 0.07),
                    ("refil", 0.61, 0.03),
                    ("updet-mix", 0.61, 0.07),
                    ("updet-vdn", 0.49, 0.04),
                    ("qmix-attn", 0.61, 0.03),
                    ("vdn-attn", 0.46, 0.09),
                    ("roma", 0.11, 0.17),
                    ("mappo", 0.27, 0.04),
                    ("mat", 0.45, 0.07),
                ],
            ),
            (
                "3-8MMM",
                &[
                    ("rit", 0.54, 0.07),
                    ("rit-vdn", 0.25, 0.03),
                    ("refil", 0.35, 0.08),
                    ("updet-mix", 0.27, 0.05),
                    ("updet-vdn", 0.20, 0.01),
                    ("qmix-attn", 0.27, 0.01),
                    ("vdn-attn", 0.16, 0.06),
                    ("roma", 0.04, 0.08),
                    ("mappo", 0.34, 0.05),
                    ("mat", 0.27, 0.04),
                ],
            ),
            (
                "3-8sz",
                &[
                    ("rit", 0.59, 0.08),
                    ("rit-vdn", 0.26, 0.07),
                    ("refil", 0.34, 0.12),
                    ("updet-mix", 0.39, 0.09),
                    ("updet-vdn", 0.18, 0.04),
                    ("qmix-attn", 0.23, 0.03),
                    ("vdn-attn", 0.13, 0.02),
                    ("roma", 0.03, 0.07),
                    ("mappo", 0.15, 0.04),
                    ("mat", 0.20, 0.04),
                ],
            ),
            (
                "3-8m",
                &[
                    ("rit", 0.84, 0.06),
                    ("rit-vdn", 0.80, 0.07),
                    ("refil", 0.82, 0.05),
                    ("updet-mix", 0.81, 0.08),
                    ("updet-vdn", 0.68, 0.04),
                    ("qmix-attn", 0.83, 0.05),
                    ("vdn-attn", 0.72, 0.10),
                    ("roma", 0.00, 0.00),
                    ("mappo", 0.63, 0.05),
                    ("mat", 0.66, 0.02),
                ],
            ),
        ],
    },
    PaperTable {
        number: "V",
        title: "Ablations, zero-shot",
        methods: &["rit", NO_ORDER, NO_TASKS, "qmix-attn"],
        columns: &[
            (
                NAVIGATION,
                &[
                    ("rit", -342.4, 14.1),
                    (NO_ORDER, -339.9, 26.9),
                    (NO_TASKS, -388.4, 16.6),
                    ("qmix-attn", -418.5, 20.2),
                ],
            ),
            (
                "3-8csz",
                &[
                    ("rit", 0.70, 0.07),
                    (NO_ORDER, 0.60, 0.10),
                    (NO_TASKS, 0.66, 0.08),
                    ("qmix-attn", 0.61, 0.03),
                ],
            ),
            (
                "3-8MMM",
                &[
                    ("rit", 0.54, 0.07),
                    (NO_ORDER, 0.51, 0.07),
                    (NO_TASKS, 0.38, 0.05),
                    ("qmix-attn", 0.27, 0.01),
                ],
            ),
            (
                "3-8sz",
                &[
                    ("rit", 0.59, 0.08),
                    (NO_ORDER, 0.43, 0.07),
                    (NO_TASKS, 0.55, 0.09),
                    ("qmix-attn", 0.23, 0.03),
                ],
            ),
        ],
    },
];

/// What people call a task set.
pub fn title(task_set: &str) -> String {
    match task_set {
        "matrix-game" => "Multi matrix game",
        NAVIGATION => "Cooperative navigation",
        "predator-prey" => "Predator and prey",
        "predator-prey-pro" => "Predator and prey pro",
        other => other,
    }
    .to_owned()
}

/// What a task set is about, in a sentence; none of those that are no part of the paper's comparison.
pub fn about(task_set: &str) -> Option<&'static str> {
    Some(match task_set {
        "matrix-game" => {
            "Two agents play one of four games that look alike; only the first reward tells which it is."
        }
        NAVIGATION => {
            "Agents are to be where landmarks are without bumping into each other; navigation-3-3 has three agents and three \
             landmarks."
        }
        "predator-prey" => {
            "Predators are to touch faster prey, which flee; predator-prey-3-2 has three predators and two prey."
        }
        "predator-prey-pro" => {
            "As predator and prey, but two predators must touch the same prey at once, and distances to prey cost at every step."
        }
        set if is_combat(set) => {
            "Battles of SMAC's kind between equal armies, played in a simulator and not in StarCraft II unless the runs' \
             settings say so: win rates are not comparable with those of the game itself, which the paper has."
        }
        _ => return None,
    })
}

/// Whether the paper played it in StarCraft II.
pub fn is_combat(task_set: &str) -> bool {
    FIGURES[1].task_sets.contains(&task_set)
}

/// A task set's place among all of them; others come last.
pub fn place(task_set: &str) -> usize {
    TaskSet::ALL.iter().position(|set| set.to_string() == task_set).unwrap_or(TaskSet::ALL.len())
}

/// A method's place by its label; variants follow what they vary, others come last.
pub fn method_place(label: &str) -> usize {
    let name = label.split(' ').next().unwrap_or(label);
    let name = name.strip_suffix(NO_PERMUTATION).unwrap_or(name);
    Method::ALL.iter().position(|method| method.facts().name == name).unwrap_or(Method::ALL.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_paper_names_is_there() {
        for table in &TABLES {
            for (task_set, rows) in table.columns {
                assert!(place(task_set) < TaskSet::ALL.len(), "{task_set}");
                assert_eq!(rows.iter().map(|row| row.0).collect::<Vec<_>>(), table.methods, "{task_set}");
            }
        }
        for figure in &FIGURES {
            assert!(figure.task_sets.iter().all(|set| place(set) < TaskSet::ALL.len()));
            assert!(figure.methods.iter().all(|label| method_place(label) < Method::ALL.len()));
        }
    }
}
