//! What groups and their members give to each other: sums, means, and the group's row for each member.

use super::{Tape, Var};
use crate::{View, ViewMut, attention::Group, math, vectorized};

impl<'a> Tape<'a> {
    /// Each group's sum of its members' rows. `x` (R, c), y (groups, c).
    pub fn sum_over_members(&mut self, x: Var, groups: &'a [Group]) -> Var {
        self.weigh_members(x, groups, Share::Whole)
    }

    /// Each group's mean of its members' rows. `x` (R, c), y (groups, c).
    pub fn mean_over_members(&mut self, x: Var, groups: &'a [Group]) -> Var {
        self.weigh_members(x, groups, Share::Equal)
    }

    fn weigh_members(&mut self, x: Var, groups: &'a [Group], share: Share) -> Var {
        let mut y = self.take(groups.len() * x.cols);
        y.fill(0.0);
        sum(groups, self.view(x), &mut y, share);
        let y = self.push(y, x.cols);
        self.record(move |back| {
            let Some(dy) = back.gradients.take(y) else { return };
            if let Some(mut dx) = back.gradients.begin(x) {
                let adds = dx.accum == crate::Accum::Add;
                spread(groups, dy.view(), dx.view_mut(), share, adds);
                back.gradients.end(dx);
            }
            back.gradients.done(dy);
        });
        y
    }

    /// Adds each group's row to the rows of its members, in place. `x` (R, c), `of_groups` (groups, c).
    pub fn add_to_members(&mut self, x: Var, of_groups: Var, groups: &'a [Group]) {
        self.write_into(x, |values, x, _| spread(groups, values.view(of_groups), x, Share::Whole, true));
        self.record(move |back| {
            // From here on the gradient belongs to the operation that made x.
            let Some(dx) = back.gradients.take(x) else { return };
            if let Some(mut d) = back.gradients.begin_adding(of_groups) {
                sum(groups, dx.view(), d.view_mut().data, Share::Whole);
                back.gradients.end(d);
            }
            back.gradients.end(dx);
        });
    }
}

/// How much of a group one member is.
#[derive(Clone, Copy, PartialEq)]
enum Share {
    Whole,
    Equal,
}

impl Share {
    #[inline(always)]
    fn of(self, group: &Group) -> f32 {
        match self {
            Self::Whole => 1.0,
            Self::Equal => 1.0 / group.queries.len() as f32,
        }
    }
}

vectorized! {
    /// sums += share · each group's rows.
    fn sum<'a>(groups: &'a [Group], rows: View<'a>, sums: &'a mut [f32], share: Share) {
        for (group, sum) in groups.iter().zip(sums.chunks_exact_mut(rows.cols)) {
            let share = share.of(group);
            for row in group.queries.clone() {
                math::add_scaled(sum, share, rows.row(row));
            }
        }
    }
}

vectorized! {
    /// rows = share · their group's row, or += where it `adds`.
    fn spread<'a>(groups: &'a [Group], of_groups: View<'a>, rows: ViewMut<'a>, share: Share, adds: bool) {
        for (at, group) in groups.iter().enumerate() {
            let share = share.of(group);
            for row in group.queries.clone() {
                if adds {
                    math::add_scaled(rows.row(row), share, of_groups.row(at));
                } else {
                    for (to, from) in rows.row(row).iter_mut().zip(of_groups.row(at)) {
                        *to = share * from;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        attention::Group,
        gradcheck::{check_operation, run_operation},
    };

    fn groups() -> Vec<Group> {
        vec![Group { queries: 0..3, keys: 0..0 }, Group { queries: 3..4, keys: 0..0 }]
    }

    #[test]
    fn sums_means_and_shares_by_hand() {
        let groups = groups();
        let x = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0];
        let out = run_operation(&[], &[(&x, 2)], |tape, x| tape.sum_over_members(x[0], &groups));
        assert_eq!(out, [9.0, 12.0, 7.0, 8.0]);
        let out = run_operation(&[], &[(&x, 2)], |tape, x| tape.mean_over_members(x[0], &groups));
        assert_eq!(out, [3.0, 4.0, 7.0, 8.0]);
        let out = run_operation(&[], &[(&[10.0, 20.0, 30.0, 40.0], 2)], |tape, of_groups| {
            let mut rows = tape.take(8);
            rows.fill(1.0);
            let rows = tape.push(rows, 2);
            tape.add_to_members(rows, of_groups[0], &groups);
            rows
        });
        assert_eq!(out, [11.0, 21.0, 11.0, 21.0, 11.0, 21.0, 31.0, 41.0]);
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let groups = groups();
        check_operation(0, &[(4, 3)], |tape, x| tape.sum_over_members(x[0], &groups));
        check_operation(0, &[(4, 3)], |tape, x| tape.mean_over_members(x[0], &groups));
        check_operation(0, &[(4, 3), (2, 3)], |tape, x| {
            let rows = tape.gather(x[0], &[0, 1, 2, 3]);
            tape.add_to_members(rows, x[1], &groups);
            rows
        });
    }
}
