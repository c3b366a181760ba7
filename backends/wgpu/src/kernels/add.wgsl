{
            // Compensated (Kahan): a lane may add thousands of numbers.
            let part = v - lost;
            let next = total + part;
            lost = (next - total) - part;
            total = next;
        }
