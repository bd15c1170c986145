//! What was found, as people and programs read it.

use crate::failure::Failure;
use rit_record::Shapley;
use std::fmt::Write as _;

/// As JSON, without the points of the figure.
///
/// # Errors
/// When it cannot be written so.
pub fn json(found: &Shapley) -> Result<String, Failure> {
    let numbers = Shapley { points: Vec::new(), own_points: Vec::new(), ..found.clone() };
    serde_json::to_string_pretty(&numbers).map(|text| text + "\n").map_err(Failure::runtime)
}

/// In words.
pub fn text(found: &Shapley) -> String {
    let number = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), |value| format!("{value:.3}"));
    let Shapley { run, task, method, agents, episodes, steps, rolled_steps, .. } = found;
    let mut text = format!(
        "{run}: {method} on {task}, {agents} agents, {episodes} greedy episodes, {steps} steps; continuations rolled from \
         {rolled_steps}\n\ncorrelation                                        all   within a step\n"
    );
    let correlations = [
        (
            "utilities, Shapley values of the learned game",
            found.utilities_learned,
            found.within_steps_learned,
        ),
        ("utilities, those of the environment's own game", found.utilities_own, found.within_steps_own),
        ("Shapley values of both games", found.learned_own, None),
    ];
    // Writing to a String does not fail.
    for (what, all, within) in correlations {
        let _ = writeln!(text, "{what:46}  {:>7}  {:>13}", number(all), number(within));
    }
    let _ = writeln!(
        text,
        "\norders M (eq. 10)  mean error  correlation      (mean |φ|: {:.4})",
        found.mean_shapley
    );
    for estimate in &found.estimates {
        let (orders, error) = (estimate.orders, estimate.mean_error);
        let _ = writeln!(text, "{orders:17}  {error:10.4}  {:>11}", number(estimate.correlation));
    }
    text += "\nsum of              against                             mean error    mean size\n";
    for residual in &found.efficiency {
        let (sum, of) = (&residual.sum, &residual.of);
        let _ =
            writeln!(text, "{sum:18}  {of:33}  {:11.4}  {:11.4}", residual.mean_error, residual.mean_size);
    }
    let symmetry = &found.symmetry;
    let _ = writeln!(
        text,
        "\n{} symmetric pairs: mean difference of Shapley values {:.4}, of utilities {:.4}, of their means over orders {:.4}",
        symmetry.pairs, symmetry.shapley, symmetry.utilities, symmetry.averaged
    );
    text
}
