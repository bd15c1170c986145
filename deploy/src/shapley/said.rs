//! What was found, as people and programs read it.

use super::Findings;
use crate::failure::Failure;
use rit_report::chart::{self, Key, Scatter};
use std::fmt::Write as _;

/// As JSON.
///
/// # Errors
/// When it cannot be written so.
pub fn json(found: &Findings) -> Result<String, Failure> {
    serde_json::to_string_pretty(found).map(|text| text + "\n").map_err(Failure::runtime)
}

/// In words.
pub fn text(found: &Findings) -> String {
    let number = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), |value| format!("{value:.3}"));
    let Findings { run, task, method, agents, episodes, steps, rolled_steps, .. } = found;
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
        let (sum, of) = (residual.sum, residual.of);
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

/// Utilities against Shapley values, and the error against M.
///
/// # Errors
/// When it cannot be drawn.
pub fn figure(found: &Findings) -> Result<String, Failure> {
    let key = |label: &str, style| Key { label: label.to_owned(), style };
    let scatter = |title: &str, places: &[[f64; 2]], style| Scatter {
        title: title.to_owned(),
        x: "Shapley value".to_owned(),
        y: "utility (M = 1)".to_owned(),
        key: key(title, style),
        places: places.to_vec(),
    };
    let scatters = [
        scatter("learned game", &found.points, 0),
        scatter("the environment's own game", &found.own_points, 3),
    ];
    let points = found.estimates.iter().map(|it| (it.orders as f64, it.mean_error)).collect();
    let error = chart::Chart {
        title: "Equation 10 with M orders".to_owned(),
        x: "M".to_owned(),
        y: "mean |estimate − Shapley value|".to_owned(),
        y_shown: vec![0.0],
        lines: vec![chart::Line { key: key(&found.method, 13), points, band: Vec::new(), runs: Vec::new() }],
        ..chart::Chart::default()
    };
    Ok(chart::scatters(&scatters, &[error])?)
}
